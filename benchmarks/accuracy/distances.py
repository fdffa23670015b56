"""Error against camera distance: sequences with known cameras, projected with a pinhole camera.

    python -m benchmarks.accuracy.distances --data DIR [--only NAME] [--points N] [--spoil KINDS] [--travel T]
        [--jitter PX] [--out FILE]

The true shapes, in camera axes, are scaled to a half-size (largest |coordinate|) of 300 px and projected from d half-sizes away into a
picture of 1280 × 720 px: u = c + x/(1 + z/φ) with φ = 300·d px and c the centre. All points are visible; the solver is given `image_size`
but not φ. Distance `inf` means orthography. `--spoil noise,drift,births,outliers,hidden,all` adds tracker errors
(`benchmarks.accuracy.spoiling`), one kind at a time. `--travel T` moves the object by T half-sizes from left to right;
`--jitter PX` adds noise, which shows how far errors of exact tracks depend on the optimum that is found. Each metric is
appended to FILE as one JSON line {method, sequence, metric, value, trial, distance, seconds}; finished measurements are not repeated.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
from pliant.solver import Settings, Tracks, solve
from pliant.solver.evaluation.metrics import evaluate

from benchmarks.accuracy.spoiling import SPOILINGS, spoiled
from benchmarks.rows import append_row, parser_of, rows
from benchmarks.sequences import Case, cases

HALF_SIZE = 300.0
"""Largest coordinate of a shape in the camera frame, px."""

PICTURE = (1280.0, 720.0)
"""Width and height, px."""

DISTANCES = ("3", "5", "10", "inf")
"""Camera distances in half-sizes."""

CAMERAS = {"auto": "auto", "orthographic": "scaled_orthographic"}
"""Camera model of each method."""

METRICS = (
    "e3d_frame_scaled", "e3d_frame_similarity", "e3d_frame", "rotation_degrees", "focal_error", "reprojection_rms",
)  # fmt: skip
"""Stored metrics, besides `mirrored` (1 where the depth sign is wrong) and `settled` (1 where the solver settled it)."""

DOWN = np.diag([1.0, -1.0, -1.0])
"""From camera axes with y up and z towards the camera to axes with y down and z away from it."""


def seen_from(case: Case, distance: float, *, travel: float = 0.0) -> tuple[Tracks, np.ndarray, np.ndarray]:
    """Return tracks in pixels, true shapes (F, P, 3) in pixels, and true rotations (F, 3, 3), y down.

    `distance` is in half-sizes, infinite for orthography; `travel` is how far the object moves to the right, from a quarter of that left
    of the optical axis, in half-sizes. Raises ValueError if the case has no true shapes or cameras.
    """
    if case.shapes is None or case.cameras is None:
        raise ValueError(f"{case.name} has no true shapes and cameras")
    rotations = DOWN @ case.cameras.rotations if case.y_up else np.asarray(case.cameras.rotations)
    shapes = case.shapes - case.shapes.mean(axis=1, keepdims=True)
    seen = shapes @ rotations.transpose(0, 2, 1)
    unit = HALF_SIZE / float(np.abs(seen).max())
    shapes, seen = unit * shapes, unit * seen
    nearer = 1 + seen[..., 2:] / (HALF_SIZE * distance)
    seen[..., 0] += travel * HALF_SIZE * np.linspace(-0.25, 0.75, len(seen))[:, None]
    return Tracks.from_arrays((np.array(PICTURE) - 1) / 2 + seen[..., :2] / nearer), shapes, rotations


def mirrored(shapes: np.ndarray, truth: np.ndarray) -> bool:
    """Return whether the mirrored shapes fit the truth better, with a free rotation per frame."""
    products = np.einsum("fpi,fpj->fij", truth - truth.mean(axis=1, keepdims=True), shapes)
    values = np.linalg.svd(products, compute_uv=False)
    sign = np.sign(np.linalg.det(products))
    return float((sign * values[:, 2]).sum()) < 0


def measure(
    case: Case, distance: str, method: str, *, spoil: str = "clean", travel: float = 0.0, jitter: float = 0.0
) -> dict[str, float]:
    """Solve one case and return its metrics; `spoil` names one of `SPOILINGS`, `jitter` is in pixels."""
    tracks, shapes, rotations = seen_from(case, float(distance), travel=travel)
    if jitter:
        noise = jitter * np.random.default_rng(1).normal(size=tracks.points.shape)
        tracks = Tracks.from_arrays(tracks.points + noise)
    tracks = spoiled(tracks, SPOILINGS[spoil])
    began = time.perf_counter()
    solution = solve(tracks, case.mesh, settings=Settings(camera=CAMERAS[method], image_size=PICTURE))  # type: ignore[arg-type]
    seconds = time.perf_counter() - began
    focal = None if distance == "inf" else HALF_SIZE * float(distance)
    values = evaluate(solution, tracks, shapes, rotations, focal)
    values["mirrored"] = float(mirrored(solution.shapes, shapes)) if solution.camera.focal is not None else 0.0
    values["settled"] = float(solution.choices.depth_sign == "settled")
    values["seconds"] = seconds
    return values


def main(arguments: list[str] | None = None) -> None:
    """Measure what is missing and print the table."""
    parser = parser_of(__doc__, out=Path("benchmarks/results/distances.jsonl"))
    parser.add_argument("--distances", default=",".join(DISTANCES), help="half-sizes, comma-separated")
    parser.add_argument("--methods", default=",".join(CAMERAS), help="comma-separated: " + ", ".join(CAMERAS))
    parser.add_argument("--spoil", default="clean", help="comma-separated: " + ", ".join(SPOILINGS))
    parser.add_argument(
        "--travel", type=float, default=0.0, help="half-sizes that the object moves through the picture"
    )
    parser.add_argument("--jitter", type=float, default=0.0, help="standard deviation of added noise, px")
    given = parser.parse_args(arguments)
    done = {(row["sequence"], row["distance"], row["method"]) for row in rows(given.out)}
    given.out.parent.mkdir(parents=True, exist_ok=True)
    print(
        f"{'sequence':26} {'d':>4} {'method':14} {'scaled':>8} {'similar':>8} {'rotation':>9} {'focal':>7} {'mirror':>6} {'s':>7}"
    )
    for case in cases(given.data, points=given.points, visibility="all", only=given.only):
        if case.shapes is None or case.cameras is None:
            continue
        kinds = [(spoil, distance, method) for spoil in given.spoil.split(",") for distance in given.distances.split(",")
                 for method in given.methods.split(",")]  # fmt: skip
        for spoil, distance, method in kinds:
            name = f"{case.name} P={case.tracks.num_points}" + ("" if spoil == "clean" else f" {spoil}")
            name += f" travel {given.travel:g}" if given.travel else ""
            name += f" jitter {given.jitter:g}" if given.jitter else ""
            if (name, distance, method) in done:
                continue
            values = measure(case, distance, method, spoil=spoil, travel=given.travel, jitter=given.jitter)
            _keep(given.out, name, distance, method, values)
            print(
                f"{name:26} {distance:>4} {method:14} {values['e3d_frame_scaled']:8.4f} {values['e3d_frame_similarity']:8.4f} "
                f"{values['rotation_degrees']:8.2f}° {values.get('focal_error', np.nan):7.3f} {values['mirrored']:6.0f} "
                f"{values['seconds']:7.1f}",
                flush=True,
            )  # fmt: skip


def _keep(path: Path, name: str, distance: str, method: str, values: dict[str, float]) -> None:
    for metric in (*METRICS, "mirrored", "settled"):
        value = values.get(metric)
        if value is None:
            continue
        row = {
            "method": method, "sequence": name, "metric": metric, "value": value if np.isfinite(value) else None,
            "trial": 0, "distance": distance, "seconds": values["seconds"],
        }  # fmt: skip
        append_row(path, row)


if __name__ == "__main__":
    main()
