"""Commands with a module of their own, beside those of `pliant.cli`."""
