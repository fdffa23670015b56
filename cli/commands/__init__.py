"""Commands that each have a module, in addition to those in `pliant.cli`."""
