"""Compare every result file, as imported by Blender and trimesh, point by point with `shapes.npz`.

    python3.11 -m venv build/blender && build/blender/bin/pip install bpy
    python -m benchmarks.imports --blender build/blender/bin/python                              the gallery's face, 99 × 29,000
    python -m benchmarks.imports --blender build/blender/bin/python --sequence DIR/facescan99_rot30
    python -m benchmarks.imports --result FOLDER                                                 a downloaded result; trimesh alone

`FOLDER` holds `shapes.npz`, `shapes.glb`, `shapes_ply.zip`, `shapes_obj.zip` and, optionally, `shapes.usdc`. Distances are in the tracks'
unit and as shares of the bounding box's diagonal.
"""

from __future__ import annotations

import argparse
import io
import json
import subprocess
import tempfile
import zipfile
from pathlib import Path

import numpy as np
import pygltflib
import trimesh
from pliant.schemas.options import Options
from pliant.worker.artifacts.geometry import upright, viewer_scale
from pliant.worker.artifacts.kinds import kinds_for

from benchmarks.files import finished, recorded
from benchmarks.rows import append_row

BLENDER_SCRIPT = Path(__file__).parent / "figures" / "blender_points.py"


def main() -> None:
    """Print a table, and append a line for each file and program to the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--result", type=Path, help="a folder of result files; by default they are written from the gallery's face"
    )
    parser.add_argument("--sequence", type=Path, help="a recorded sequence whose true shapes stand for the result")
    parser.add_argument("--frames", type=int, default=99)
    parser.add_argument("--points", type=int, default=29_000)
    parser.add_argument("--blender", type=Path, help="an interpreter with bpy")
    parser.add_argument("--results", type=Path, help="JSON lines to append to")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = given.result or written(Path(scratch), given)
        rows = compared(folder, Path(scratch), given.blender)
    print("| file | MB | program | largest distance | share of the diagonal |")
    print("|---|---|---|---|---|")
    for row in rows:
        print(
            f"| {row['file']} | {row['bytes'] / 1e6:.1f} | {row['program']} | {row['distance']:.2e} | {row['share']:.1e} |"
        )
    if given.results is not None:
        for row in rows:
            append_row(given.results, row)


def written(folder: Path, given: argparse.Namespace) -> Path:
    """Write the files of a finished job."""
    options = Options(outputs="glb,ply,obj,usd")
    result = (
        finished(given.frames, given.points, options) if given.sequence is None else recorded(given.sequence, options)
    )
    for kind in kinds_for(options):
        with (folder / kind.name).open("wb") as file:
            kind.write(result, file, lambda _: None)
    return folder


def compared(folder: Path, scratch: Path, blender: Path | None) -> list[dict[str, object]]:
    """Return a row for each file and program: the largest distance from `shapes.npz` over the first, middle and last frame."""
    with np.load(folder / "shapes.npz") as arrays:
        shapes = arrays["shapes"]
    gltf = pygltflib.GLTF2.load(str(folder / "shapes.glb"))
    told = gltf.meshes[0].extras["pliant"]
    fps = 1 / gltf.accessors[gltf.animations[0].samplers[0].input].max[0] * (len(shapes) - 1)
    frames = [0, len(shapes) // 2, len(shapes) - 1]
    scale = viewer_scale(shapes)
    standing = upright(shapes[frames], y_axis(folder)) * scale
    diagonal = float(np.linalg.norm(np.ptp(standing, axis=(0, 1))))
    found = {("trimesh " + trimesh.__version__, name): each for name, each in by_trimesh(folder, frames).items()}
    if blender is not None:
        found |= by_blender(folder, scratch, blender, fps, frames)
    rows = []
    for (program, name), points in found.items():
        size = 1.0 if name.startswith(("shapes.glb", "shapes.usd")) else scale
        distance = float(np.linalg.norm(points * size - standing, axis=2).max())
        rows.append(
            {
                "file": name, "program": program, "bytes": (folder / name).stat().st_size, "distance": distance / scale,
                "share": distance / diagonal, "frames": len(shapes), "points": shapes.shape[1],
                "encoding": told["encoding"] if name == "shapes.glb" else None,
            }
        )  # fmt: skip
    return rows


def y_axis(folder: Path) -> str:
    """Return the direction of the tracks' y axis from the report; `down` without a report."""
    report = folder / "report.json"
    return json.loads(report.read_text())["interpretation"]["y_axis"] if report.exists() else "down"


def by_trimesh(folder: Path, frames: list[int]) -> dict[str, np.ndarray]:
    """Return the points `(3, P, 3)` of PLY and OBJ; trimesh does not play animations, so only Blender reads glTF and USD."""
    found = {}
    for name in ("ply", "obj"):
        with zipfile.ZipFile(folder / f"shapes_{name}.zip") as archive:
            stills = [
                trimesh.load(
                    io.BytesIO(archive.read(f"frame_{frame:05d}.{name}")), file_type=name, process=False, maintain_order=True
                ).vertices
                for frame in frames
            ]  # fmt: skip
        found[f"shapes_{name}.zip"] = np.stack(stills)
    return found


def by_blender(
    folder: Path, scratch: Path, blender: Path, fps: float, frames: list[int]
) -> dict[tuple[str, str], np.ndarray]:
    """Return the points of all files, turned back from Blender's axes (z up) to y up."""
    for name in ("ply", "obj"):
        with zipfile.ZipFile(folder / f"shapes_{name}.zip") as archive:
            archive.extractall(scratch / name, [f"frame_{frame:05d}.{name}" for frame in frames])
    for name in ("shapes.glb", "shapes.usdc"):
        if (folder / name).exists() and not (scratch / name).exists():
            (scratch / name).symlink_to((folder / name).resolve())
    out = scratch / "blender.npz"
    command = [str(blender), str(BLENDER_SCRIPT), str(scratch), str(out), f"{fps:.9g}", *map(str, frames)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    with np.load(out) as arrays:
        program = f"Blender {arrays['blender']}"
        return {(program, name): arrays[name][..., [0, 2, 1]] * (1, 1, -1) for name in arrays if name != "blender"}


if __name__ == "__main__":
    main()
