"""Numbers as colours, on the one scale that all pictures of this package have; of depths, bright is near."""

import cv2
import numpy as np

# Names of colour maps in OpenCV, and in matplotlib for depths, which rise where their pictures darken. Its dark end is
# no black, which says that there is no number, and is seen on a dark ground.
COLOUR_MAP, DEPTHS_IN_MATPLOTLIB = "VIRIDIS", "viridis_r"


def coloured(levels: np.ndarray, colour_map: str = COLOUR_MAP) -> np.ndarray:
    """Numbers [...] from 0 (dark) to 1 (bright) as RGB [..., 3] uint8; black where there is no finite number."""
    finite = np.isfinite(levels)
    grey = (255 * np.clip(np.where(finite, levels, 0.0), 0.0, 1.0)).astype(np.uint8)
    colours = cv2.applyColorMap(grey.reshape(-1, 1), getattr(cv2, f"COLORMAP_{colour_map}"))[:, 0, ::-1]
    return np.where(finite[..., None], colours.reshape(*grey.shape, 3), 0).astype(np.uint8)


def depth_picture(depth: np.ndarray, *, near: float, far: float) -> np.ndarray:
    """Depth [H, W] as colours [H, W, 3] uint8 RGB: inverse depth, bright near, dark far, black where invalid."""
    valid = np.isfinite(depth) & (depth > 0)
    return coloured(np.where(valid, depth_levels(np.where(valid, depth, 1.0), near=near, far=far), np.nan))


def depth_limits(depth: np.ndarray) -> tuple[float, float]:
    """Near and far end of a scale for depth [...]: nearly all that is valid lies between them, the 2nd and the 98th
    percentile. They differ; 1 and 2 where nothing is valid."""
    valid = depth[np.isfinite(depth) & (depth > 0)]
    if not valid.size:
        return 1.0, 2.0
    near, far = np.percentile(valid, (2, 98)).tolist()
    return near, max(far, 1.001 * near)


def depth_levels(depth: np.ndarray, *, near: float, far: float) -> np.ndarray:
    """Where valid depths [...] lie between `far` (0) and `near` (1) by their inverses; may be beyond."""
    return (1.0 / depth - 1.0 / far) / max(1.0 / near - 1.0 / far, 1e-12)
