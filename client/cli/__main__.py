"""`python -m pliant.client.cli` is `pliant`."""

from __future__ import annotations

from pliant.client.cli import main

if __name__ == "__main__":
    main()
