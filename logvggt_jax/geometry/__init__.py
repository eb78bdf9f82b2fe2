"""Pure functions on arrays: rotations, cameras, pose encodings, similarity transforms.

Functions take numpy or JAX arrays and answer in kind (the array API's namespace of the argument). Products are
written as multiply-and-sum, so that no accelerator rounds them to bfloat16 or TF32.
"""

from logvggt_jax.geometry.cameras import (
    LARGEST_ENTRY,
    as_matrix,
    camera_centres,
    compose,
    invert,
    points_at,
    project,
    relative_to_first,
    transform_points,
    unproject,
    unproject_pixels,
)
from logvggt_jax.geometry.pose_encoding import decode_poses, encode_poses
from logvggt_jax.geometry.rotations import (
    is_rotation,
    matrix_to_quaternion,
    nearest_rotation,
    quaternion_to_matrix,
    rotation_angle,
)
from logvggt_jax.geometry.similarity import NoSimilarity, Similarity, pose_similarity, robust_similarity, umeyama
from logvggt_jax.geometry.similarity_group import (
    log_derivative,
    scale_of,
    similarity_adjoint,
    similarity_exp,
    similarity_log,
)

__all__ = [
    "LARGEST_ENTRY",
    "NoSimilarity",
    "Similarity",
    "as_matrix",
    "camera_centres",
    "compose",
    "decode_poses",
    "encode_poses",
    "invert",
    "is_rotation",
    "log_derivative",
    "matrix_to_quaternion",
    "nearest_rotation",
    "points_at",
    "pose_similarity",
    "project",
    "quaternion_to_matrix",
    "relative_to_first",
    "robust_similarity",
    "rotation_angle",
    "scale_of",
    "similarity_adjoint",
    "similarity_exp",
    "similarity_log",
    "transform_points",
    "umeyama",
    "unproject",
    "unproject_pixels",
]
