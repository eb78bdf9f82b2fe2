"""Numbers as colours, on the one scale that all pictures of this package have."""

import cv2
import numpy as np


def coloured(levels: np.ndarray) -> np.ndarray:
    """Numbers [H, W] from 0 (dark) to 1 (bright) as RGB [H, W, 3] uint8; black where there is no finite number."""
    finite = np.isfinite(levels)
    grey = (255 * np.clip(np.where(finite, levels, 0.0), 0.0, 1.0)).astype(np.uint8)
    colours = cv2.cvtColor(cv2.applyColorMap(grey, cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB)
    return np.where(finite[..., None], colours, 0).astype(np.uint8)


def depth_picture(depth: np.ndarray, *, near: float, far: float) -> np.ndarray:
    """Depth [H, W] as colours [H, W, 3] uint8 RGB: inverse depth, bright near, dark far, black where invalid."""
    valid = np.isfinite(depth) & (depth > 0)
    inverse = 1.0 / np.where(valid, depth, 1.0)
    return coloured(np.where(valid, (inverse - 1.0 / far) / max(1.0 / near - 1.0 / far, 1e-12), np.nan))
