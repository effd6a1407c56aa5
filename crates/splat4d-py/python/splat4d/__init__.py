"""Moving 3D scenes of Gaussians: scenes as NumPy arrays, captures, training (docs/python.md)."""

from ._native import (
    Camera,
    Capture,
    Error,
    Frame,
    Gaussians,
    Rendering,
    Run,
    Scene,
    Tracks,
    View,
    __version__,
    command,
    metrics,
    open,
    photometric,
    resume,
    train,
)
from .motion import Motion

__all__ = [
    "Camera",
    "Capture",
    "Error",
    "Frame",
    "Gaussians",
    "Motion",
    "Rendering",
    "Run",
    "Scene",
    "Tracks",
    "View",
    "__version__",
    "command",
    "metrics",
    "open",
    "photometric",
    "resume",
    "train",
]
