"""One small sequence, written the way each program and data set writes it: the table of formats that docs/reference/formats.md shows.

The points are the 5 × 9 pixels of a tiny picture, on a sheet that turns and waves. Every number is a small multiple of a power of two,
so that dividing by (width − 1, height − 1) = (8, 4) and multiplying again gives the same bits.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import hdf5storage
import numpy as np
import scipy.io

F, ROWS, COLUMNS = 8, 5, 9
P = ROWS * COLUMNS
WIDTH, HEIGHT = COLUMNS, ROWS


def _sheet() -> np.ndarray:
    y, x = np.mgrid[:ROWS, :COLUMNS].astype(float)
    angle = np.linspace(0, 0.7, F)[:, None, None]
    depth = np.sin(x / 2 + 2 * angle) * y / 4 - np.sin(x / 2) * y / 4 * (angle == 0)
    turned = np.stack([(x - 4) * np.cos(angle) + depth * np.sin(angle) + 4, y + 0.3 * angle * depth], axis=-1)
    return np.round(turned * 1024) / 1024


def _world() -> np.ndarray:
    depth = np.ldexp(1.0, np.arange(F * P).reshape(F, P) % 3)
    return np.stack([(POINTS[..., 0] - 4) * depth / 8, (POINTS[..., 1] - 2) * depth / 8, depth], axis=-1)


POINTS = _sheet().reshape(F, P, 2)
SEEN = np.random.default_rng(3).random((F, P)) > 0.1
LOGITS = np.where(SEEN, 4.0, -4.0) + np.linspace(-1, 1, F * P).reshape(F, P)
WORLD = _world()
"""Points before a camera with fx = fy = 8, cx = 4, cy = 2 whose picture is POINTS."""

MATRIX = POINTS.transpose(0, 2, 1).reshape(2 * F, P)
"""W: rows x1, y1, x2, y2 …"""

STACKED = np.vstack([POINTS[..., 0], POINTS[..., 1]])
SHAPES = np.concatenate([POINTS - 4, np.sin(POINTS[..., :1])], axis=2)
HIDDEN = np.where(SEEN[..., None], POINTS, np.nan)


def sigmoid(logits: np.ndarray) -> np.ndarray:
    return 1.0 / (1.0 + np.exp(-logits))


def pixels(points: np.ndarray) -> np.ndarray:
    """Points as whole pictures, (F, H, W, …)."""
    return points.reshape(F, ROWS, COLUMNS, *points.shape[2:])


@dataclass(frozen=True)
class Written:
    """One format: its row in the documentation, how to write a file, and the contents of the canonical file."""

    title: str
    layout: str
    write: Callable[[Path], Any]
    suffix: str = "npz"
    recognised: str = "canonical"
    options: Mapping[str, Any] = field(default_factory=dict)
    points: np.ndarray = field(default_factory=lambda: POINTS)
    visibility: np.ndarray | None = field(default_factory=lambda: SEEN)
    truth: np.ndarray | None = None

    def __str__(self) -> str:
        return self.title


def npz(**arrays: Any) -> Callable[[Path], None]:
    return lambda path: np.savez(path, **arrays)


def mat(**variables: Any) -> Callable[[Path], None]:
    return lambda path: scipy.io.savemat(path, variables)


def mat73(**variables: Any) -> Callable[[Path], None]:
    return lambda path: hdf5storage.savemat(str(path), variables, format="7.3", store_python_metadata=False)


def table(
    *, separator: str = ",", header: str = "frame,point,x,y,visible", seen: bool = True
) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        lines = [header.replace(",", separator)]
        for f in range(F):
            for p in range(P):
                x, y = POINTS[f, p].tolist()
                last = [str(int(SEEN[f, p]))] if seen else []
                if seen or SEEN[f, p]:
                    lines.append(separator.join([str(f), str(p), repr(x), repr(y), *last]))
        path.write_text("\n".join(lines) + "\n")

    return write


def cells(arrays: np.ndarray) -> np.ndarray:
    """A MATLAB cell array 1 × F with one matrix a frame."""
    found = np.empty((1, len(arrays)), dtype=object)  # noqa: TID251
    for index, array in enumerate(arrays):
        found[0, index] = array
    return found


FRAMES = POINTS.transpose(0, 2, 1)
"""2 × P for each frame."""

TAPIR = (1.0 - sigmoid(-LOGITS)) * (1.0 - sigmoid(-LOGITS - 2))
DOT = np.concatenate([POINTS, np.where(SEEN, 0.875, 0.25)[..., None]], axis=2)
UNIT = np.concatenate([POINTS / [WIDTH - 1, HEIGHT - 1], DOT[..., 2:]], axis=2)
CONFIDENCE = np.stack([np.where(SEEN, 0.875, 0.25), np.full((F, P), 0.75)], axis=-1)
STRUCT = {"tracks2d": {"W": MATRIX, "note": "made"}, "frames": 8}
INTRINSICS = np.array([8.0, 8.0, 4.0, 2.0])

FORMATS = (
    Written("canonical npz", "`tracks (F, P, 2)`, `visibility (F, P)`", npz(tracks=POINTS, visibility=SEEN)),
    Written("npz, points first", "`tracks (P, F, 2)`, `visibility (P, F)`; option `layout=points_frames`",
            npz(tracks=POINTS.swapaxes(0, 1), visibility=SEEN.T), options={"layout": "points_frames"}),
    Written("matrix npz", "`W (2F, P)`", npz(W=MATRIX), recognised="matrix", visibility=None),
    Written("npy", "`(F, P, 2)`, NaN where hidden", lambda path: np.save(path, HIDDEN), "npy", "unnamed"),
    Written("npy matrix", "`(2F, P)`, NaN where hidden",
            lambda path: np.save(path, HIDDEN.transpose(0, 2, 1).reshape(2 * F, P)), "npy", "unnamed"),
    Written("CoTracker", "`pred_tracks (B, T, N, 2)`, `pred_visibility (B, T, N)` or `(B, T, N, 1)` bool",
            npz(pred_tracks=POINTS[None], pred_visibility=SEEN[None, ..., None]), recognised="CoTracker"),
    Written("TAPIR, BootsTAPIR", "`tracks (B, N, T, 2)`, `occlusion (B, N, T)`, `expected_dist (B, N, T)` logits",
            npz(tracks=POINTS.swapaxes(0, 1)[None], occlusion=-LOGITS.T[None], expected_dist=-LOGITS.T[None] - 2),
            recognised="TAPIR, BootsTAPIR or LocoTrack", visibility=np.where(TAPIR < 0.5, 0, TAPIR)),
    Written("TAPIR, BootsTAPIR after its own rule", "`tracks (N, T, 2)`, `visibles (N, T)` bool",
            npz(tracks=POINTS.swapaxes(0, 1), visibles=SEEN.T), recognised="TAPIR, BootsTAPIR or LocoTrack"),
    Written("LocoTrack", "`tracks (B, N, T, 2)`, `occlusion (B, N, T)` logits",
            npz(tracks=POINTS.swapaxes(0, 1)[None], occlusion=-LOGITS.T[None]),
            recognised="TAPIR, BootsTAPIR or LocoTrack", visibility=np.where(SEEN, 1 - sigmoid(-LOGITS), 0)),
    Written("TAPNext", "`tracks (B, T, N, 2)`, `visible_logits (B, T, N, 1)`",
            npz(tracks=POINTS[None], visible_logits=LOGITS[None, ..., None]), recognised="TAPNext",
            visibility=np.where(SEEN, sigmoid(LOGITS), 0)),
    Written("TAPNext, as its model returns it", "`tracks (B, T, N, 2)` y before x; option `coordinate_order=yx`",
            npz(tracks=POINTS[None, ..., ::-1], visible_logits=LOGITS[None, ..., None]), recognised="TAPNext",
            options={"coordinate_order": "yx"}, visibility=np.where(SEEN, sigmoid(LOGITS), 0)),
    Written("TAP-Vid", "`points (N, T, 2)` from 0 to 1, `occluded (N, T)`; option `image_size`",
            npz(points=UNIT[..., :2].swapaxes(0, 1), occluded=~SEEN.T), recognised="TAP-Vid", options={"image_size": "9x5"}),
    Written("AllTracker", "`trajs_e (B, T, N, 2)`, `visconfs_e (B, T, N, 2)`",
            npz(trajs_e=POINTS[None], visconfs_e=CONFIDENCE[None]), recognised="AllTracker",
            visibility=np.where(SEEN, 0.875 * 0.75, 0)),
    Written("AllTracker, whole pictures", "`traj_maps_e (B, T, 2, H, W)`, `visconf_maps_e (B, T, 2, H, W)`",
            npz(traj_maps_e=np.moveaxis(pixels(POINTS), 3, 1)[None], visconf_maps_e=np.moveaxis(pixels(CONFIDENCE), 3, 1)[None]),
            recognised="AllTracker", visibility=np.where(SEEN, 0.875 * 0.75, 0)),
    Written("PIPs++", "`trajs_e (B, S, N, 2)`", npz(trajs_e=POINTS[None]), recognised="PIPs++", visibility=None),
    Written("OpenCV, its frames stacked", "`tracks (F, P, 1, 2)`, `visibility (F, P, 1)` of 0 and 1",
            npz(tracks=POINTS[:, :, None], visibility=SEEN[..., None].astype(np.uint8))),
    Written("DOT", "`tracks (B, T, N, 3)`: x, y, visibility", npz(tracks=DOT[None]), recognised="DOT", visibility=np.where(SEEN, 0.875, 0)),
    Written("DOT, fractions of the picture", "`tracks (B, T, N, 3)`: x / (W − 1), y / (H − 1), visibility; option `image_size`",
            npz(tracks=UNIT[None]), recognised="DOT", options={"image_size": "9x5"}, visibility=np.where(SEEN, 0.875, 0)),
    Written("DOT, whole pictures", "`tracks (B, T, H, W, 3)` in pixels", npz(tracks=pixels(DOT)[None]), recognised="DOT",
            visibility=np.where(SEEN, 0.875, 0)),
    Written("DOT, whole pictures in fractions", "`tracks (T, H, W, 3)` in fractions", npz(tracks=pixels(UNIT)), recognised="DOT",
            visibility=np.where(SEEN, 0.875, 0)),
    Written("TAPVid-3D", "`tracks_xyz` or `tracks_XYZ (T, N, 3)`, `visibility (T, N)`, `intrinsics` or `fx_fy_cx_cy (4,)`",
            npz(tracks_XYZ=WORLD, visibility=SEEN, fx_fy_cx_cy=INTRINSICS, images_jpeg_bytes=np.array([b"jpeg"] * F, dtype=object)),
            recognised="TAPVid-3D", truth=WORLD),
    Written("MATLAB v5, interleaved", "`W (2F, P)`: x1, y1, x2, y2 …; `S (3F, P)`, `Rs (2F, 3)`",
            mat(W=MATRIX, S=SHAPES.transpose(0, 2, 1).reshape(3 * F, P), Rs=np.tile(np.eye(3)[:2], (F, 1))), "mat", "matrix",
            visibility=None, truth=SHAPES),
    Written("MATLAB v5, stacked", "`W (2F, P)`: all x, then all y; `P3_gt (3F, P)`, `MD (F, P)` 1 where missing",
            mat(W=STACKED, P3_gt=np.vstack([*SHAPES.transpose(2, 0, 1)]), MD=(~SEEN).astype(float)), "mat", "matrix", truth=SHAPES),
    Written("MATLAB v5, 2 × P × F", "`W (2, P, F)`, `S (3, P, F)`",
            mat(W=POINTS.transpose(2, 1, 0), S=SHAPES.transpose(2, 1, 0)), "mat", "matrix", visibility=None, truth=SHAPES),
    Written("MATLAB v5, nested structs", "`data.tracks2d.W (2F, P)`", mat(data=STRUCT), "mat", "matrix", visibility=None),
    Written("MATLAB v5, a cell for each frame", "`W {1, F}` of `(2, P)`", mat(W=cells(FRAMES)), "mat", "matrix", visibility=None),
    Written("MATLAB v5, NaN where missing", "`W (2F, P)`", mat(W=HIDDEN.transpose(0, 2, 1).reshape(2 * F, P)), "mat", "matrix"),
    Written("MATLAB v7.3, interleaved", "`W (2F, P)`, `S (3F, P)`",
            mat73(W=MATRIX, S=SHAPES.transpose(0, 2, 1).reshape(3 * F, P)), "mat", "matrix", visibility=None, truth=SHAPES),
    Written("MATLAB v7.3, stacked", "`W (2F, P)`", mat73(W=STACKED), "mat", "matrix", visibility=None),
    Written("MATLAB v7.3, 2 × P × F", "`W (2, P, F)`", mat73(W=POINTS.transpose(2, 1, 0)), "mat", "matrix", visibility=None),
    Written("MATLAB v7.3, nested structs", "`data.tracks2d.W (2F, P)`", mat73(data=STRUCT), "mat", "matrix", visibility=None),
    Written("MATLAB v7.3, a cell for each frame", "`W {1, F}` of `(2, P)`", mat73(W=cells(FRAMES)), "mat", "matrix", visibility=None),
    Written("CSV", "columns `frame`, `point`, `x`, `y`, `visible`, by name in any order", table(), "csv"),
    Written("CSV without visibility", "`frame`, `point`, `x`, `y`; observations without a line are hidden",
            table(seen=False, header="frame,point,x,y"), "csv"),
    Written("CSV with semicolons or tabs", "as above, separated by `;` or tabs", table(separator=";"), "csv"),
)  # fmt: skip
