"""The cameras of a result as one animated glTF camera, which sees the mesh as the picture shows it.

A glTF camera looks along its −Z axis with +Y up, and its projection is symmetric about that axis: there is no principal point. The view is
therefore centred on the principal point c, and large enough to hold the whole picture; where c is the picture's centre, the view is the
picture. With a view of W × H pixels and normalized device coordinates n a point of the image is c + (n_x W, ∓n_y H) / 2, the lower sign
for tracks with y up.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pliant.solver.records import Camera
from pliant.worker.artifacts.geometry import Floats, Singles

MARGIN = 2.0
"""Near and far planes lie this factor before the nearest and beyond the farthest point."""

NEAREST = 1e-3
"""Near plane in units of the farthest point's depth, for shapes that reach behind the camera."""

BACK = 4.0
"""Distance of an orthographic camera from the shapes, in units of their largest distance from the origin: all of them are in view."""


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A glTF camera and the motion of its node."""

    lens: dict[str, Any]
    """The glTF camera."""

    rotations: Singles
    """World from camera, unit quaternions x, y, z, w without jumps of sign, shape `(F, 4)`."""

    translations: Singles
    """Positions of the camera in the units of the file's scene, shape `(F, 3)`."""


def view_of(
    camera: Camera, shapes: Floats, *, y_axis: str, scale: float, image_size: tuple[float, float] | None = None
) -> View:
    """Return the glTF camera for shapes `(F, P, 3)`, which the scene contains rotated to y up and multiplied by `scale`.

    A glTF camera cannot change its magnification: for orthographic cameras it is the geometric mean of the scales, and the range of the
    scales is listed in `extras`. `y_axis` is the direction of the tracks' y axis. Without `image_size`, pixels, the view contains all
    projected points.
    """
    axes = np.array([1.0, -1.0, -1.0]) if y_axis == "down" else np.ones(3)
    centre = _centre(camera, image_size)
    size = _size(camera, shapes, centre, image_size)
    rotations = axes[:, None] * camera.rotations * axes
    magnification = float(np.exp(np.log(camera.scales).mean()))
    if camera.focal is None:
        back = BACK * max(float(np.linalg.norm(shapes, axis=2).max()), np.finfo(float).tiny)
        away = np.full(len(rotations), back)
        places = np.column_stack([(camera.translations - centre) / magnification, away * axes[2] * -1])
    else:
        away = camera.focal / camera.scales
        places = np.column_stack([(camera.translations - centre) / camera.scales[:, None], away * axes[2] * -1])
    depths = away[:, None] - axes[2] * np.einsum("fpi,fi->fp", shapes, camera.rotations[:, 2])
    far = MARGIN * float(depths.max()) * scale
    near = max(float(depths.min()) * scale / MARGIN, NEAREST * far)
    lens: dict[str, Any] = {"name": "camera", "extras": {"pliant": _stated(camera, centre, size, image_size)}}
    if camera.focal is None:
        half = scale * size / (2 * magnification)
        lens |= {"type": "orthographic", "orthographic": {"xmag": half[0], "ymag": half[1], "zfar": far, "znear": near}}
    else:
        angle = 2 * atan(size[1] / (2 * camera.focal))
        lens |= {
            "type": "perspective",
            "perspective": {"aspectRatio": float(size[0] / size[1]), "yfov": angle, "zfar": far, "znear": near},
        }
    turned = rotations.transpose(0, 2, 1)
    origins = -scale * np.einsum("fij,fj->fi", turned, places * axes)
    return View(lens, _quaternions(turned), origins.astype(np.float32))


def _centre(camera: Camera, image_size: tuple[float, float] | None) -> Floats:
    """Return the image position that the view is centred on."""
    if camera.focal is not None:
        return np.asarray(camera.principal_point)
    return camera.translations.mean(axis=0) if image_size is None else (np.array(image_size) - 1) / 2


def _size(
    camera: Camera, shapes: Floats, centre: Floats, image_size: tuple[float, float] | None
) -> NDArray[np.float64]:
    """Return width and height of the smallest view about `centre` that holds the picture, or all points."""
    if image_size is None:
        reach = np.abs(camera.project(shapes) - centre).max(axis=(0, 1))
    else:
        reach = np.maximum(centre + 0.5, np.array(image_size) - 0.5 - centre)
    return np.asarray(2 * np.maximum(reach, 1e-9))


def _stated(camera: Camera, centre: Floats, size: Floats, image_size: tuple[float, float] | None) -> dict[str, Any]:
    stated: dict[str, Any] = {"view_centre": centre.tolist(), "view_size": size.tolist()}
    if image_size is not None:
        stated["image_size"] = list(image_size)
    if camera.focal is not None:
        return {**stated, "focal": camera.focal, "principal_point": camera.principal_point.tolist()}
    return {**stated, "scale_range": [float(camera.scales.min()), float(camera.scales.max())]}


def _quaternions(rotations: Floats) -> Singles:
    """Return unit quaternions x, y, z, w; neighbours are in one hemisphere, so that viewers interpolate along the shorter arc."""
    from scipy.spatial.transform import Rotation  # imported here, because the API process writes no files

    found = Rotation.from_matrix(rotations).as_quat()
    turns = np.where((found[1:] * found[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    return np.asarray(found * np.concatenate([[1.0], np.cumprod(turns)])[:, None], dtype=np.float32)
