from collections.abc import Callable, Sequence
from os import PathLike
from typing import Any, Literal, final, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .motion import Motion

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
    def __new__(
        cls,
        means: ArrayLike,
        quats: ArrayLike,
        scales: ArrayLike,
        opacities: ArrayLike,
        *,
        sh: ArrayLike | None = None,
        colors: ArrayLike | None = None,
        time: float = 0.0,
    ) -> Gaussians: ...
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
class Rendering:
    @property
    def color(self) -> _F32: ...
    @property
    def alpha(self) -> _F32: ...
    @property
    def depth(self) -> _F32: ...
    def backward(
        self, color: ArrayLike | None = None, alpha: ArrayLike | None = None, depth: ArrayLike | None = None
    ) -> dict[str, Any]: ...

@final
class Scene:
    @staticmethod
    def from_arrays(
        means: ArrayLike,
        quats: ArrayLike,
        scales: ArrayLike,
        opacities: ArrayLike,
        *,
        sh: ArrayLike | None = None,
        colors: ArrayLike | None = None,
        times: ArrayLike | None = None,
        velocities: ArrayLike | None = None,
        rotation_rates: ArrayLike | None = None,
        centers: ArrayLike | None = None,
        durations: ArrayLike | None = None,
        fps: float = 30.0,
        clip: tuple[float, float] | None = None,
        up: ArrayLike | None = None,
        background: ArrayLike | None = None,
    ) -> Scene: ...
    @staticmethod
    def from_frames(
        frames: Sequence[Gaussians],
        *,
        fps: float = 30.0,
        up: ArrayLike | None = None,
        background: ArrayLike | None = None,
    ) -> Scene: ...
    def parameters(self) -> dict[str, _F32]: ...
    def with_parameters(self, parameters: dict[str, ArrayLike]) -> Scene: ...
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
    @overload
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
        requires_grad: Literal[False] = False,
    ) -> _F32: ...
    @overload
    def render(
        self,
        camera: Camera,
        t: float,
        *,
        background: ArrayLike | None = None,
        requires_grad: Literal[True],
    ) -> Rendering: ...
    def tracks(self, every: int = 1, times: ArrayLike | None = None) -> Tracks: ...
    def bake(self, path: _Path, *, tolerance: float | None = None, ladder: list[float] | None = None) -> None: ...
    def export(self, path: _Path, t: float | None = None) -> None: ...
    def export_frames(
        self,
        folder: _Path,
        *,
        fps: float | None = None,
        start: float | None = None,
        end: float | None = None,
        world: bool = False,
        force: bool = False,
    ) -> int: ...
    def export_mesh(
        self,
        path: _Path,
        t: float | None = None,
        *,
        voxel: float = 0.02,
        watertight: bool = False,
        collision: bool = False,
        fps: float | None = None,
        start: float | None = None,
        end: float | None = None,
        force: bool = False,
    ) -> int: ...
    def export_tracks(
        self,
        path: _Path,
        *,
        every: int = 1,
        near: Sequence[float] | None = None,
        count: int = 1,
        label: str | None = None,
        points: _Path | None = None,
        fps: float | None = None,
        start: float | None = None,
        end: float | None = None,
        world: bool = False,
    ) -> None: ...
    def film(
        self,
        path: _Path,
        *,
        route: str | None = None,
        size: tuple[int, int] | None = None,
        start: float | None = None,
        end: float | None = None,
        freeze: float | None = None,
        slow_motion: float | None = None,
        seconds: float | None = None,
        fps: float | None = None,
        channel: str = "color",
        shutter: float | None = None,
        aperture: float | None = None,
        focus: float | tuple[float, float] | None = None,
        samples: int | None = None,
        projection: Literal["perspective", "equirectangular"] = "perspective",
        stereo: Literal["side-by-side", "over-under"] | None = None,
        eye_distance: float | None = None,
        transparent: bool = False,
        transfer: Literal["linear", "srgb"] | None = None,
        force: bool = False,
        device: _Device = "auto",
    ) -> None: ...
    def localise(self, images: Sequence[_Path], *, start: _Path | None = None, lens: bool = False) -> list[dict[str, Any]]: ...
    def edit(self, edits: str | _Path) -> Scene: ...
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
    def priors(self, networks: dict[str, _Path], described: dict[str, str] | None = None, force: bool = False) -> Any: ...
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
    def status(self) -> dict[str, Any]: ...
    def evaluate(self, *, device: _Device = "auto", lpips_weights: _Path | None = None) -> dict[str, Any]: ...
    def report(self) -> Any: ...
    def compress(
        self,
        out: _Path | None = None,
        *,
        level: Literal[0, 1, 2] = 2,
        prune: float | None = None,
        max_mb: float | None = None,
        fine_tune: int | None = None,
        guard: float = 0.5,
        unpruned: bool = False,
        evaluate: bool = True,
        force: bool = False,
        device: _Device = "auto",
        **settings: Any,
    ) -> Run: ...
    def label(self, capture: _Path | None = None, *, rounds: int | None = None) -> None: ...
    def predict(
        self,
        *,
        models: Sequence[str] | None = None,
        horizon: int | None = None,
        seeds: int = 1,
        nodes: int = 48,
        steps: int = 1500,
        film: bool = True,
    ) -> dict[str, Any]: ...

def open(path: _Path, *, motion: Motion | None = None) -> Scene: ...
def import_videos(
    videos: Sequence[_Path],
    out: _Path,
    *,
    rig: Literal["auto", "fixed", "moving"] = "auto",
    every: int = 1,
    start: float | None = None,
    end: float | None = None,
    size: int = 1080,
    fps: float = 30.0,
    sound: bool = True,
    synchronous: bool = False,
    crop: Literal["auto"] | tuple[int, int, int, int] | None = None,
    apart: tuple[str, str, float] | None = None,
    board: str | None = None,
    camera_height: tuple[str, float] | None = None,
    calibration: _Path | None = None,
    colmap: bool = False,
    points: _Path | None = None,
    keypoints: _Path | None = None,
    matcher: _Path | None = None,
    described: str | None = None,
    masks: _Path | None = None,
    deinterlace: bool = False,
    png: bool = False,
    check: bool = True,
) -> Capture: ...
def info(path: _Path, *, doctor: _Path | None = None, **settings: Any) -> dict[str, Any]: ...
def compare(runs: Sequence[_Path], outputs: Sequence[_Path] = ()) -> list[dict[str, Any]]: ...
def metrics(render: ArrayLike, truth: ArrayLike) -> dict[str, float]: ...
def photometric(render: ArrayLike, truth: ArrayLike, lambda_dssim: float = 0.2) -> tuple[float, _F32]: ...
def train(
    capture: Capture | _Path,
    out: _Path | None = None,
    *,
    motion: str | Motion | None = None,
    progress: _Progress | Literal[False] | None = None,
    loss: _Loss | None = None,
    minutes: float | None = None,
    quality: Literal["draft", "standard", "best"] | None = None,
    device: _Device = "auto",
    evaluate: bool = False,
    force: bool = False,
    follow: bool = False,
    **settings: Any,
) -> Run: ...
def resume(
    run: Run | _Path,
    *,
    motion: Motion | None = None,
    progress: _Progress | Literal[False] | None = None,
    loss: _Loss | None = None,
    device: _Device = "auto",
    evaluate: bool = False,
) -> Run: ...
def command(*words: _Path) -> list[dict[str, Any]]: ...
def main(words: Sequence[str]) -> int: ...
