"""What options can be chosen from, spelled out here since the registries themselves would load JAX."""

METHOD_NAMES = ("windows", "chunks", "offline", "merged", "causal", "anchored-window", "rolling", "pruned")
FORMATS = (
    *("colmap", "colmap-text", "nerfstudio", "glb", "ply", "tum", "kitti", "euroc"),
    *("depth-png", "depth-exr", "depth-npz", "rosbag2"),
)
