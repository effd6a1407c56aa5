"""The command: `splat4d`, `s4d`, or `python -m splat4d`."""

import signal
import sys

from . import _native


def main() -> None:
    # Python's own handler waits for its interpreter, which has nothing to do while the command works.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    sys.exit(_native.main(["splat4d", *sys.argv[1:]]))


if __name__ == "__main__":
    main()
