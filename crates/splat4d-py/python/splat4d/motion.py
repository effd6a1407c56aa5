"""Motion models of your own (docs/own-motion-python.md)."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np


class Motion:
    """A motion model of your own, for `train(..., motion=...)`, `resume` and `open`.

    `function(params, t)` returns the Gaussians at second t: means [N, 3], quats [N, 4] (wxyz, of any length), scales [N, 3],
    opacities [N] and, with `colors=True`, colours [N, 3] (without, the spherical harmonics are shown). `params` is a dict of
    arrays: `means` [N, 3], `quats` [N, 4], `log_scales` [N, 3], `opacity_logits` [N] and `sh` [N, K, 3] of the canonical
    Gaussians that are requested, and the model's own, which start at zero or as they are given: `per_gaussian` (name:
    numbers per Gaussian), whose rows are copied and removed with the Gaussians, and `shared` (name: array).

    With PyTorch, `params` are tensors, and gradients come from autograd. Without, give `backward(params, t, d_means, d_quats,
    d_scales, d_opacities, d_colors)`, which returns a dict of gradients by the names of `params` (and of `time`, if the
    clocks of cameras are to be refined).

    `rates` (name: rate, or (first, last)) are learning rates of the model's own arrays; arrays without a rate are not changed.
    The Gaussians are trained at the recipe's rates. In the first `warmup` share of the steps only they are trained, as a
    static scene.
    """

    def __init__(
        self,
        function: Callable[[dict[str, Any], Any], tuple[Any, ...]],
        *,
        name: str = "own",
        per_gaussian: Mapping[str, int] | None = None,
        shared: Mapping[str, Any] | None = None,
        rates: Mapping[str, float | tuple[float, float]] | None = None,
        warmup: float = 0.05,
        colors: bool = False,
        backward: Callable[..., dict[str, Any]] | None = None,
    ) -> None:
        self.function = function
        self.name = name
        self.per_gaussian = dict(per_gaussian or {})
        self.shared = dict(shared or {})
        self.rates = dict(rates or {})
        self.warmup = warmup
        self.colors = colors
        self._backward = backward

    @classmethod
    def of_module(cls, module: Any, *, rate: float | tuple[float, float] = (1e-3, 1e-4), **options: Any) -> "Motion":
        """The motion of a `torch.nn.Module` whose `forward(params, t)` is the function; its parameters are the shared arrays."""
        import torch

        names = {parameter: parameter.replace(".", "_") for parameter, _ in module.named_parameters()}

        def function(params: dict[str, Any], t: Any) -> tuple[Any, ...]:
            weights = {parameter: params[name] for parameter, name in names.items()}
            return torch.func.functional_call(module, weights, (params, t))

        shared = {names[p]: value.detach().cpu().numpy() for p, value in module.named_parameters()}
        rates = {name: rate for name in shared} | dict(options.pop("rates", None) or {})
        return cls(function, shared=shared | dict(options.pop("shared", None) or {}), rates=rates, **options)

    def forward(self, params: dict[str, Any], t: float) -> tuple[Any, ...]:
        """What training calls: means, quats, scales, opacities, colours or None, and what `backward` needs."""
        if self._backward is not None:
            answer = tuple(self.function(params, t))
            return (*self._five(answer), (params, t))
        import torch

        with torch.enable_grad():
            leaves = {name: torch.from_numpy(np.ascontiguousarray(a)).requires_grad_() for name, a in params.items()}
            time = torch.tensor(t, dtype=torch.float32, requires_grad=True)
            answer = self._five(tuple(self.function(leaves, time)))
        arrays = [None if a is None else a.detach().cpu().numpy() for a in answer]
        return (*arrays, (leaves, time, answer))

    def backward(
        self, tape: Any, d_means: Any, d_quats: Any, d_scales: Any, d_opacities: Any, d_colors: Any
    ) -> dict[str, Any]:
        """What training calls with the gradients of the loss to what `forward` returned: gradients to `params`, by name."""
        gradients = (d_means, d_quats, d_scales, d_opacities, d_colors)
        if self._backward is not None:
            params, t = tape
            return self._backward(params, t, *gradients)
        import torch

        leaves, time, answer = tape
        pairs = [(a, torch.from_numpy(g)) for a, g in zip(answer, gradients) if a is not None and g is not None]
        pairs = [(a, g.to(a.device, a.dtype)) for a, g in pairs if a.requires_grad]
        if not pairs:
            return {}
        inputs = [*leaves.values(), time]
        found = torch.autograd.grad([a for a, _ in pairs], inputs, [g for _, g in pairs], allow_unused=True)
        back = {name: g.cpu().numpy() for name, g in zip(leaves, found) if g is not None}
        if found[-1] is not None:
            back["time"] = float(found[-1])
        return back

    def _five(self, answer: tuple[Any, ...]) -> tuple[Any, ...]:
        wanted = 5 if self.colors else 4
        if len(answer) != wanted:
            parts = "means, quats, scales, opacities" + (", colours" if self.colors else "")
            raise ValueError(f"the motion returned {len(answer)} things; return {parts}")
        return answer if self.colors else (*answer, None)

    def __repr__(self) -> str:
        return f"Motion({self.name!r})"
