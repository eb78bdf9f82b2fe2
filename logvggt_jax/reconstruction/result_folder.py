"""What lies in a result folder, by name."""

from logvggt_jax.files import FolderKind
from logvggt_jax.reconstruction.cameras_file import CAMERAS_FILE
from logvggt_jax.reconstruction.depth_files import DEPTH_FOLDER, IMAGE_FOLDER, ORIGINAL_FOLDER
from logvggt_jax.reconstruction.health.report import HEALTH_FILE, HEALTH_PAGE

TRAJECTORY_FILE = "trajectory.txt"
POINTS_FILE = "points.ply"
PREVIEW_FOLDER = "previews"
EXPORT_FOLDER = "exports"
# Of what is not finished: the state that a run goes on from.
PROGRESS_FOLDER = ".progress"
RESULT = FolderKind(
    marker=CAMERAS_FILE,
    names=(
        *(CAMERAS_FILE, TRAJECTORY_FILE, POINTS_FILE, HEALTH_FILE, HEALTH_PAGE),
        *(DEPTH_FOLDER, IMAGE_FOLDER, ORIGINAL_FOLDER, PREVIEW_FOLDER, EXPORT_FOLDER, PROGRESS_FOLDER),
    ),
)
