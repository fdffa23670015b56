"""A film's result as a picture: the film, the mesh drawn over it, and the textured mesh from the side, frame by frame.

    python -m benchmarks.figures.film_pictures RESULT --film FILM [--at 0,15,29] [--side 40] [--plain] -o PICTURE

RESULT is the folder of `pliant solve FILM` or `pliant demo` (`tracks.npz`, `shapes.npz`). `--plain` omits the film and its texture, for
films that may not be shown, and draws the mesh from the front and from both sides. A positive `--side` looks from the right of the camera:
near parts, such as a nose, point to the left. If they point to the right, the shape is hollow, although its picture may look like a face.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image
from pliant.solver import Camera
from pliant.tracking import open_film

from benchmarks.figures.shading import draw_mesh

SPLIT = 4
"""Subdivisions of a quad's side in drawings, so that the texture is sharper than the mesh."""

GAP = 6
"""Pixels between pictures."""

SHADE = 0.75
"""Opacity of the mesh over the film."""


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """A film's result; world axes x right, y down, z away from the viewer."""

    shapes: np.ndarray
    faces: np.ndarray
    camera: Camera
    uv: np.ndarray
    texture: np.ndarray
    frames: np.ndarray
    """Numbers of the F frames in the film."""


def read_result(folder: Path) -> Result:
    """Read `shapes.npz` and `tracks.npz` of a film's result."""
    with np.load(folder / "shapes.npz") as solved, np.load(folder / "tracks.npz") as tracked:
        kept = solved.get("source_points", np.arange(tracked["tracks"].shape[1]))
        focal = float(solved["focal"])
        camera = Camera(
            solved["rotations"], solved["scales"], solved["translations"], focal if np.isfinite(focal) else None,
            principal_point=solved["principal_point"],
        )  # fmt: skip
        return Result(
            solved["shapes"], solved["faces"], camera, tracked["uv"][kept], tracked["template_image"], tracked["frame_indices"]
        )  # fmt: skip


def draw(result: Result, film: Path | None, frames: list[int], *, side: float, height: int) -> Image.Image:
    """Draw a row of pictures for each frame, `height` pixels high, seen from `side` degrees beside the camera.

    Without a film, draw only the mesh, from three directions.
    """
    rows = []
    pictures = {} if film is None else _film_frames(film, {int(result.frames[frame]) for frame in frames})
    for frame in frames:
        if film is None:
            columns = [_aside(result, frame, angle, height, textured=False) for angle in (0.0, side, -side)]
        else:
            picture = _scaled(pictures[int(result.frames[frame])], height)
            columns = [picture, _over(result, frame, picture), _aside(result, frame, side, height, textured=True)]
        rows.append(_joined(columns, axis=1))
    return Image.fromarray(np.round(255 * np.clip(_joined(rows, axis=0), 0, 1)).astype(np.uint8))


def _film_frames(film: Path, wanted: set[int]) -> dict[int, np.ndarray]:
    return {frame.index: frame.image / 255 for frame in open_film(film).frames() if frame.index in wanted}


def _scaled(picture: np.ndarray, height: int) -> np.ndarray:
    size = (round(picture.shape[1] * height / picture.shape[0]), height)
    return (
        np.asarray(Image.fromarray(np.round(255 * picture).astype(np.uint8)).resize(size, Image.Resampling.LANCZOS))
        / 255
    )


def _over(result: Result, frame: int, picture: np.ndarray) -> np.ndarray:
    """Draw the mesh over a picture, as the estimated camera sees it."""
    shape = result.shapes[frame : frame + 1]
    camera = result.camera.at(slice(frame, frame + 1))
    pixels, depths = camera.project(shape)[0], camera.depths(shape)[0]
    scale = picture.shape[0] / result.texture.shape[0]
    points = np.column_stack([(pixels + 0.5) * scale, depths * scale])
    where = {
        "size": picture.shape[:2],
        "scale": 1.0,
        "centre": (picture.shape[1] / 2, picture.shape[0] / 2),
        "background": 0.0,
    }
    drawn = draw_mesh(points, result.faces, **where)
    covered = draw_mesh(points, result.faces, colours=np.ones((len(points), 3)), **where)[..., :1] > 0
    return np.where(covered, SHADE * drawn + (1 - SHADE) * picture, picture)


def _aside(result: Result, frame: int, side: float, height: int, *, textured: bool) -> np.ndarray:
    """Draw the mesh from `side` degrees beside the frame's camera; one scale for all frames."""
    turned = result.shapes @ result.camera.rotations.transpose(0, 2, 1)
    angle = np.radians(side)
    about = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    views = turned @ about.T
    extent = np.abs(views[..., :2] - np.median(views[..., :2], axis=1, keepdims=True)).max(axis=(0, 1))
    scale = 0.46 * height / float(extent[1])
    size = (height, max(height // 2, round(2.1 * scale * float(extent[0]))))
    points, faces, places = _split(views[frame], result.faces, result.uv)
    colours = _sampled(result.texture, places) if textured else None
    middle = np.median(views[frame][:, :2], axis=0)
    return draw_mesh(
        points, faces, size=size, scale=scale, centre=(float(middle[0]), float(middle[1])), colours=colours
    )


def _split(points: np.ndarray, faces: np.ndarray, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Split every quad into SPLIT × SPLIT, interpolating positions and texture coordinates bilinearly."""
    if faces.shape[1] != 4:
        return points, faces, uv
    step = np.linspace(0, 1, SPLIT + 1)
    down, right = (each.reshape(-1) for each in np.meshgrid(step, step, indexing="ij"))
    # Corners run down the left side first: (0, 0), (1, 0), (1, 1), (0, 1) in (down, right).
    weights = np.stack([(1 - down) * (1 - right), down * (1 - right), down * right, (1 - down) * right], axis=1)
    both = np.concatenate([points, uv], axis=1)
    fine = np.einsum("kc,tcd->tkd", weights, both[faces]).reshape(-1, 5)
    grid = np.arange((SPLIT + 1) ** 2).reshape(SPLIT + 1, SPLIT + 1)
    cell = np.stack([grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]], axis=-1).reshape(-1, 4)
    return (
        fine[:, :3],
        (cell[None] + (SPLIT + 1) ** 2 * np.arange(len(faces))[:, None, None]).reshape(-1, 4),
        fine[:, 3:],
    )


def _sampled(texture: np.ndarray, places: np.ndarray) -> np.ndarray:
    height, width = texture.shape[:2]
    column = np.clip(np.round(places[:, 0] * width - 0.5), 0, width - 1).astype(int)
    row = np.clip(np.round(places[:, 1] * height - 0.5), 0, height - 1).astype(int)
    return texture[row, column] / 255


def _joined(pictures: list[np.ndarray], *, axis: int) -> np.ndarray:
    """Join pictures side by side (axis 1) or one below the other (axis 0), centred on white."""
    other = 1 - axis
    largest = max(picture.shape[other] for picture in pictures)
    parts = []
    for number, picture in enumerate(pictures):
        missing = largest - picture.shape[other]
        pad = [(0, 0), (0, 0), (0, 0)]
        pad[other] = (missing // 2, missing - missing // 2)
        pad[axis] = (GAP if number else 0, 0)
        parts.append(np.pad(picture, pad, constant_values=1.0))
    return np.concatenate(parts, axis=axis)


def main(arguments: list[str] | None = None) -> None:
    """Draw and save."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("result", type=Path, help="folder with tracks.npz and shapes.npz")
    parser.add_argument("--film", type=Path, help="the film; not needed with --plain")
    parser.add_argument("--at", default="", help="frames, comma-separated; three by default")
    parser.add_argument("--side", type=float, default=40.0, help="degrees beside the camera")
    parser.add_argument("--height", type=int, default=240, help="of one picture, pixels")
    parser.add_argument("--plain", action="store_true", help="the mesh alone")
    parser.add_argument("-o", "--output", type=Path, required=True)
    given = parser.parse_args(arguments)
    if given.film is None and not given.plain:
        parser.error("--film is missing; --plain draws the mesh alone")
    result = read_result(given.result)
    last = len(result.shapes) - 1
    frames = [int(each) for each in given.at.split(",")] if given.at else [0, last // 2, last]
    picture = draw(result, None if given.plain else given.film, frames, side=given.side, height=given.height)
    given.output.parent.mkdir(parents=True, exist_ok=True)
    picture.save(given.output, optimize=True)
    print(given.output)


if __name__ == "__main__":
    main()
