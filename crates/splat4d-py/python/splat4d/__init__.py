"""Moving 3D scenes of Gaussians: scenes as NumPy arrays, captures, training (docs/python.md)."""

from ._native import (
    Camera,
    Capture,
    Error,
    Frame,
    Gaussians,
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

__all__ = [
    "Camera",
    "Capture",
    "Error",
    "Frame",
    "Gaussians",
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
