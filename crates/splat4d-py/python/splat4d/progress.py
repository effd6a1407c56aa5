"""A progress bar on a terminal and in notebooks."""

import sys
from typing import Any

# Characters of the bar, and how often at most a notebook draws it, seconds.
WIDTH = 24
NOTEBOOK_SECONDS = 0.5


def shown() -> "Bar | None":
    """The bar for this process; None without a terminal or notebook."""
    if "ipykernel" in sys.modules:
        return Notebook()
    return Bar() if sys.stderr is not None and sys.stderr.isatty() else None


def duration(seconds: float) -> str:
    """1:05 or 2:03:04."""
    minutes, rest = divmod(max(0, round(seconds)), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


def line(event: dict[str, Any]) -> str | None:
    """The line that an event of training stands for; None: the event changes nothing."""
    if event["type"] == "phase":
        share = f" {event['done']}/{event['total']}" if event["total"] else ""
        return f"{event['name']}{share}"
    if event["type"] == "progress":
        done = event["iteration"] / max(1, event["iterations"])
        filled = "█" * round(WIDTH * done)
        return (
            f"{event['stage']} {filled:·<{WIDTH}} {event['iteration']}/{event['iterations']}, {event['psnr']:.1f} dB,"
            f" {event['gaussians']} Gaussians, {duration(event['seconds_left'])} left"
        )
    if event["type"] == "finished":
        return f"trained {event['iteration']} steps in {duration(event['seconds'])}, {event['gaussians']} Gaussians"
    return None


class Bar:
    """One line on standard error that is written again and again."""

    def __init__(self) -> None:
        self.length = 0

    def __call__(self, event: dict[str, Any]) -> None:
        text = line(event)
        if text is None:
            return
        end = "\n" if event["type"] == "finished" else ""
        sys.stderr.write("\r" + text.ljust(self.length) + end)
        sys.stderr.flush()
        self.length = 0 if end else len(text)


class Notebook(Bar):
    """The same line in the output of a notebook's cell."""

    def __init__(self) -> None:
        super().__init__()
        self.last = 0.0
        self.handle: Any = None

    def __call__(self, event: dict[str, Any]) -> None:
        import time

        from IPython.display import display

        text = line(event)
        now = time.monotonic()
        if text is None or (event["type"] != "finished" and now - self.last < NOTEBOOK_SECONDS):
            return
        self.last = now
        shown_text = {"text/plain": text}
        if self.handle is None:
            self.handle = display(shown_text, raw=True, display_id=True)
        else:
            self.handle.update(shown_text, raw=True)
