"""Run one small solve with one solver constant multiplied, in a separate process, for `benchmarks.accuracy.sensitivity`.

    python -m benchmarks.accuracy.changed_constant CASE [MODULE NAME FACTOR SECONDS]

The constant is changed in the module's source during import, so values computed from it change too. The solver must not be imported
earlier. The kernel kills the process after SECONDS of processor time.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import json
import resource
import sys
import time
import warnings
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, SourceFileLoader
from types import CodeType, ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from benchmarks.sequences import Case


class ChangedConstant(MetaPathFinder):
    """Import hook that multiplies one constant of a module, or every number in its value; see `multiplied`."""

    def __init__(self, module: str, name: str, factor: float) -> None:
        """Multiply `name` in `module` by `factor`."""
        self.module, self.name, self.factor = module, name, factor

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return the module's spec with a loader that changes its source."""
        if fullname != self.module:
            return None
        for finder in sys.meta_path:
            spec = None if finder is self else finder.find_spec(fullname, path, target)
            if spec is not None and isinstance(spec.loader, SourceFileLoader):
                spec.loader = _Loader(fullname, spec.loader.path, self.name, self.factor)
                return spec
        return None


class _Loader(SourceFileLoader):
    def __init__(self, fullname: str, path: str, name: str, factor: float) -> None:
        super().__init__(fullname, path)
        self._name, self._factor = name, factor

    def get_code(self, fullname: str) -> CodeType:
        path = self.get_filename(fullname)
        tree = changed(ast.parse(self.get_data(path)), self._name, self._factor)
        return compile(tree, path, "exec")


def changed(tree: ast.Module, name: str, factor: float) -> ast.Module:
    """Return the module with every number in the value of the constant multiplied.

    Raises
    ------
    LookupError
        The module assigns no number to `name` at top level.
    """
    for statement in tree.body:
        value = constants_of(statement).get(name)
        if value is not None:
            found = [node for node in ast.walk(value) if _is_number(node)]
            for node in found:
                node.value = multiplied(node.value, factor)  # type: ignore[attr-defined]
            if found:
                return tree
    raise LookupError(f"The module assigns no number to {name}.")


def multiplied(value: float, factor: float) -> float:
    """Return the product; positive integers stay integers of at least 1, other integers are unchanged."""
    if isinstance(value, int):
        return max(1, round(value * factor)) if value > 0 else value
    return value * factor


def constants_of(statement: ast.stmt) -> dict[str, ast.expr]:
    """Return the upper-case names to which a top-level statement assigns numbers, with the assigned expressions."""
    if isinstance(statement, ast.AnnAssign) and statement.value is not None:
        pairs = [(statement.target, statement.value)]
    elif isinstance(statement, ast.Assign):
        target, value = statement.targets[0], statement.value
        together = isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple)
        pairs = list(zip(target.elts, value.elts, strict=True)) if together else [(target, value)]  # type: ignore[attr-defined]
    else:
        return {}
    return {
        target.id: value
        for target, value in pairs
        if isinstance(target, ast.Name) and target.id.isupper() and any(map(_is_number, ast.walk(value)))
    }


def _is_number(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and type(node.value) in (int, float)


def made(name: str) -> tuple[Case, dict[str, Any]]:
    """Return a small sequence by name and its settings; `case.cameras` holds the cameras given to the solver, if any."""
    from dataclasses import replace

    from pliant.solver import gallery

    from benchmarks.accuracy.distances import PICTURE, seen_from
    from benchmarks.sequences import from_gallery, rolled_sheet

    kind, _, how = name.partition(", ")
    if kind == "sheet":
        return rolled_sheet(), {"image_size": (640.0, 480.0)}
    if kind == "flag":
        sequence = gallery.flag(16, 100)
    else:
        sequence = gallery.face(16, 100, degrees=40, scale_change=0.05 if how in ("", "errors") else 0.0)
    case = from_gallery(sequence, name)
    if how == "lens":
        tracks, shapes, _ = seen_from(case, 3.0)
        return replace(case, tracks=tracks, shapes=shapes, cameras=None), {"image_size": PICTURE}
    if how == "":
        return replace(case, cameras=None), {}
    tracks, _ = gallery.corrupt_tracks(case.tracks, noise=0.01, outliers=0.1, hidden=0.2)
    return replace(case, tracks=tracks, cameras=case.cameras if how == "given cameras" else None), {}


def main() -> None:
    """Solve, and print error, processor seconds and a digest of the shapes as one JSON line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("case", metavar="CASE")
    parser.add_argument("change", nargs="*", help="MODULE NAME FACTOR SECONDS")
    given = parser.parse_args()
    if given.change:
        module, constant, factor, seconds = given.change
        sys.meta_path.insert(0, ChangedConstant(module, constant, float(factor)))
        resource.setrlimit(resource.RLIMIT_CPU, (int(seconds), int(seconds)))
    from pliant.solver import Settings, solve
    from pliant.solver.evaluation.metrics import e3d_frame_scaled

    case, settings = made(given.case)
    assert case.shapes is not None
    warnings.simplefilter("ignore")
    began = time.process_time()
    shapes = solve(case.tracks, case.mesh, cameras=case.cameras, settings=Settings(**settings)).shapes
    row = {
        "e3d_frame_scaled": e3d_frame_scaled(shapes, case.shapes),
        "cpu_seconds": round(time.process_time() - began, 2),
        "digest": hashlib.sha256(shapes.tobytes()).hexdigest()[:16],
    }
    print(json.dumps(row))


if __name__ == "__main__":
    main()
