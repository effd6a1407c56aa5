from collections.abc import Callable, Sequence
from os import PathLike
from typing import Any, Literal, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

_Path = str | PathLike[str]
_F32 = NDArray[np.float32]
_F64 = NDArray[np.float64]
_Device = Literal["cpu", "gpu", "auto"]
_Progress = Callable[[dict[str, Any]], object]
_Loss = Callable[[_F32, _F32, "View"], tuple[float, ArrayLike]]

__version__: str

class Error(Exception):
    """What went wrong, where, and what to do."""

    kind: Literal["bad_input", "io", "unsupported", "memory", "diverged", "interrupted", "failed"]

@final
class Camera:
    def __new__(
        cls,
        width: int,
        height: int,
        fx: float,
        fy: float | None = None,
        cx: float | None = None,
        cy: float | None = None,
        world_to_camera: ArrayLike | None = None,
        near: float = ...,
    ) -> Camera: ...
    @staticmethod
    def look_at(
        position: ArrayLike,
        target: ArrayLike,
        up: ArrayLike,
        *,
        width: int = 800,
        height: int = 600,
        fov_y: float = 45.0,
        near: float = ...,
    ) -> Camera: ...
    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int: ...
    @property
    def fx(self) -> float: ...
    @property
    def fy(self) -> float: ...
    @property
    def cx(self) -> float: ...
    @property
    def cy(self) -> float: ...
    @property
    def near(self) -> float: ...
    @property
    def world_to_camera(self) -> _F64: ...
    @property
    def K(self) -> _F64: ...
    @property
    def position(self) -> list[float]: ...
    def downscaled(self, k: int) -> Camera: ...

@final
class Gaussians:
    @property
    def time(self) -> float: ...
    @property
    def means(self) -> _F32: ...
    @property
    def quats(self) -> _F32: ...
    @property
    def scales(self) -> _F32: ...
    @property
    def opacities(self) -> _F32: ...
    @property
    def sh(self) -> _F32: ...
    def __len__(self) -> int: ...

@final
class Tracks:
    @property
    def times(self) -> _F64: ...
    @property
    def points(self) -> _F32: ...
    @property
    def layers(self) -> NDArray[np.uint32]: ...
    @property
    def rows(self) -> NDArray[np.uint32]: ...

@final
class Scene:
    @property
    def clip(self) -> tuple[float, float]: ...
    @property
    def fps(self) -> float: ...
    @property
    def up(self) -> list[float]: ...
    @property
    def offset(self) -> list[float]: ...
    @property
    def background(self) -> list[float]: ...
    @property
    def labels(self) -> list[str]: ...
    @property
    def cameras(self) -> list[tuple[str, Camera]]: ...
    def at(self, t: float) -> Gaussians: ...
    def render(
        self,
        camera: Camera,
        t: float,
        *,
        channel: Literal[
            "color", "alpha", "depth", "flow", "velocity", "normal", "label", "feature", "life", "uncertainty"
        ] = "color",
        background: ArrayLike | None = None,
        device: _Device = "cpu",
    ) -> _F32: ...
    def tracks(self, every: int = 1, times: ArrayLike | None = None) -> Tracks: ...
    def bake(self, path: _Path, *, tolerance: float | None = None) -> None: ...
    def export(self, path: _Path, t: float | None = None) -> None: ...
    def __len__(self) -> int: ...

@final
class Frame:
    number: int
    name: str
    camera: Camera
    time: float
    index: int
    split: Literal["train", "test", "val", "future"]
    file: Any

@final
class Capture:
    def __new__(cls, path: _Path, **settings: Any) -> Capture: ...
    @classmethod
    def from_arrays(
        cls,
        images: Sequence[Any] | NDArray[Any],
        cameras: Sequence[Camera | Sequence[Camera]],
        times: ArrayLike | Sequence[ArrayLike] | None = None,
        points: ArrayLike | None = None,
        *,
        colors: ArrayLike | None = None,
        names: Sequence[str] | None = None,
        fps: float | None = None,
        up: ArrayLike | None = None,
        hold_out: Sequence[str] | None = None,
        folder: _Path | None = None,
    ) -> Capture: ...
    @property
    def path(self) -> Any: ...
    @property
    def name(self) -> str: ...
    @property
    def cameras(self) -> list[str]: ...
    @property
    def times(self) -> list[float]: ...
    @property
    def fps(self) -> float: ...
    @property
    def up(self) -> list[float]: ...
    @property
    def offset(self) -> list[float]: ...
    @property
    def warnings(self) -> list[str]: ...
    @property
    def points(self) -> tuple[_F64, _F32] | None: ...
    def image(self, i: int) -> _F32: ...
    def mask(self, i: int) -> _F32 | None: ...
    def __len__(self) -> int: ...
    def __getitem__(self, i: int, /) -> Frame: ...

@final
class View:
    time: float
    frame: int
    camera: int
    iteration: int

@final
class Run:
    def __new__(cls, path: _Path) -> Run: ...
    @property
    def path(self) -> Any: ...
    @property
    def finished(self) -> bool: ...
    @property
    def iteration(self) -> int | None: ...
    @property
    def info(self) -> dict[str, Any]: ...
    @property
    def results(self) -> dict[str, Any] | None: ...
    def scene(self) -> Scene: ...
    def evaluate(self) -> dict[str, Any]: ...

def open(path: _Path) -> Scene: ...
def metrics(render: ArrayLike, truth: ArrayLike) -> dict[str, float]: ...
def photometric(render: ArrayLike, truth: ArrayLike, lambda_dssim: float = 0.2) -> tuple[float, _F32]: ...
def train(
    capture: Capture | _Path,
    out: _Path | None = None,
    *,
    progress: _Progress | None = None,
    loss: _Loss | None = None,
    minutes: float | None = None,
    quality: Literal["draft", "standard", "best"] | None = None,
    device: _Device = "cpu",
    **settings: Any,
) -> Run: ...
def resume(
    run: Run | _Path,
    *,
    progress: _Progress | None = None,
    loss: _Loss | None = None,
    device: _Device = "cpu",
) -> Run: ...
def command(*words: _Path) -> None: ...
def main(words: Sequence[str]) -> int: ...
