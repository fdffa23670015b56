"""Entry point of `python -m pliant.cli`, which equals `pliant`."""

from __future__ import annotations

from pliant.cli import main

if __name__ == "__main__":
    main()
