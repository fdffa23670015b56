"""Films with exact truth: a textured gallery surface in front of a background, seen by a pinhole camera.

The demonstration and the tests track these films and compare the result with `RenderedFilm.follow`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pliant.solver.gallery import Sequence
from pliant.solver.mesh import triangles_of
from pliant.tracking.errors import FilmError
from pliant.tracking.rendering.rasterising import Floats, Ints, Surface, rasterise

SUPERSAMPLING = 2
"""Samples per pixel side."""

WAVES = 80
"""Number of plane waves in a texture."""

FINEST, COARSEST = 6.0, 0.35
"""Wavelengths of a texture: the finest in pixels, which sampling and blur leave visible, the coarsest in image heights."""

FRECKLES, DIM = 0.32, 0.45
"""With paint: how much the texture varies its brightness, and the brightness of the background, as shares."""

LAYER = 0.04
"""A point is visible if it is at most this far behind the nearest surface, in radii of the object. The facets of a gallery mesh deviate
less from one another; two layers of a closed body are further apart."""

CODECS = {".avi": "FFV1", ".mkv": "FFV1", ".mp4": "mp4v", ".mov": "mp4v", ".webm": "VP80"}
"""Codec by file suffix; FFV1 is lossless, the others are the ones that every OpenCV wheel encodes."""


@dataclass(frozen=True, slots=True, eq=False)
class RenderedFilm:
    """A film that is rendered frame by frame on demand, with its truth."""

    size: tuple[int, int]
    """Width and height in pixels."""

    focal: float
    """Focal length in pixels; the principal point is the image centre, `((W − 1) / 2, (H − 1) / 2)`."""

    shapes: Floats
    """True vertices, shape `(F, P, 3)`, camera axes: x right, y down, z away from the viewer; the camera is at 0."""

    triangles: Ints
    """Shape `(T, 3)`."""

    rest: Floats
    """Vertices in the coordinates of the solid texture, shape `(P, 3)`, film pixels."""

    blur: float
    """Standard deviation of the lens blur in pixels."""

    noise: float
    """Standard deviation of the noise in grey levels (0–255), drawn anew for each frame."""

    paint: Floats | None
    """Colour of every vertex, shape `(P, 3)`, grey levels; the texture then changes only its brightness. None: the texture alone."""

    occluder: bool
    """Whether a textured bar passes in front of the object once."""

    seed: int
    """Seed of texture, background and noise."""

    @property
    def num_frames(self) -> int:
        """F."""
        return len(self.shapes)

    @property
    def pixels(self) -> Floats:
        """Projected vertices, shape `(F, P, 2)`."""
        return self._project(self.shapes)

    def frame(self, index: int) -> NDArray[np.uint8]:
        """Render one frame, shape `(H, W, 3)`, RGB."""
        fine = SUPERSAMPLING
        width, height = self.size[0] * fine, self.size[1] * fine
        surface = self._surface(index, fine)
        x, y = np.meshgrid((np.arange(width) + 0.5) / fine - 0.5, (np.arange(height) + 0.5) / fine - 0.5)
        here = np.stack([x, y, np.zeros_like(x)], axis=-1)
        time = index / max(self.num_frames - 1, 1)
        drift = np.array([0.02 * self.size[0] * time, 0.0, 0.0])
        image = 0.7 * texture(here.reshape(-1, 3) + drift, self.size[1], self.seed + 1).reshape(height, width, 3) + 20
        covered = surface.triangle >= 0
        corners = self.rest[self.triangles[surface.triangle[covered]]]
        image[covered] = texture(np.einsum("nk,nkc->nc", surface.weights[covered], corners), self.size[1], self.seed)
        if self.paint is not None:
            image[~covered] = DIM * image[~covered]
            colour = np.einsum(
                "nk,nkc->nc", surface.weights[covered], self.paint[self.triangles[surface.triangle[covered]]]
            )
            image[covered] = colour * (1 + FRECKLES * (image[covered].mean(axis=1, keepdims=True) / 127.5 - 1))
        if self.occluder:
            left, right = self._bar(index)
            behind = (x >= left) & (x <= right)
            image[behind] = texture(here[behind] - (left, 0, 0), self.size[1], self.seed + 2)
        small = image.reshape(self.size[1], fine, self.size[0], fine, 3).mean(axis=(1, 3))
        if self.blur > 0:
            small = cv2.GaussianBlur(small, (0, 0), self.blur)
        grain = np.random.default_rng((self.seed, index)).standard_normal(small.shape)
        return np.asarray(np.clip(np.round(small + self.noise * grain), 0, 255), dtype=np.uint8)

    def region(self, index: int) -> NDArray[np.bool_]:
        """Return the pixels that show the object, shape `(H, W)`."""
        mask = self._surface(index, 1).triangle >= 0
        if self.occluder:
            left, right = self._bar(index)
            columns = np.arange(self.size[0])
            mask &= ~((columns >= left) & (columns <= right))
        return mask

    def follow(self, points: Floats, index: int) -> tuple[Floats, NDArray[np.bool_], Floats]:
        """Follow surface points, given by their pixels in frame `index`, through the film.

        Parameters
        ----------
        points : array, shape (N, 2)
            Pixel positions in frame `index`, on the object.
        index
            Frame of the points.

        Returns
        -------
        tracks : array, shape (F, N, 2)
            True pixels, NaN for points that are not on the object.
        visible : array, shape (F, N)
            Whether the object shows the point.
        shapes : array, shape (F, N, 3)
            Points in space.
        """
        corner, weights = self._hit(points, index)
        shapes = np.einsum("nk,fnkc->fnc", weights, self.shapes[:, corner])
        tracks = self._project(shapes)
        visible = np.stack([self._sees(tracks[t], shapes[t, :, 2], t) for t in range(self.num_frames)])
        return tracks, visible & np.isfinite(tracks[..., 0]), shapes

    def write(
        self, path: Path | str, *, fps: float = 30.0, frame: Callable[[int], NDArray[np.uint8]] | None = None
    ) -> Path:
        """Encode the film; `.avi` and `.mkv` are lossless, `.mp4`, `.mov` and `.webm` lossy.

        Parameters
        ----------
        path
            The file to write.
        fps
            Frames per second.
        frame
            Function that renders a frame by its index, instead of `self.frame`.

        Raises
        ------
        FilmError
            An unknown suffix, or a file that cannot be written.
        """
        target = Path(path)
        code = CODECS.get(target.suffix.lower())
        if code is None:
            raise FilmError(
                "unsupported_film",
                field="path",
                expected=f"a name that ends in {', '.join(sorted(CODECS))}",
                got=target.name,
                hint="Choose another suffix.",
            )
        writer = cv2.VideoWriter(str(target), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*code), fps, self.size)
        try:
            if not writer.isOpened():
                raise FilmError(
                    "unwritable_film",
                    field="path",
                    expected="a file that can be written",
                    got=str(target),
                    hint="Check the folder and its permissions.",
                )
            for index in range(self.num_frames):
                writer.write(cv2.cvtColor((frame or self.frame)(index), cv2.COLOR_RGB2BGR))
        finally:
            writer.release()
        return target

    def _project(self, points: Floats) -> Floats:
        centre = (np.array(self.size) - 1) / 2
        return np.asarray(self.focal * points[..., :2] / points[..., 2:] + centre)

    def _surface(self, index: int, fine: int) -> Surface:
        shape = self.shapes[index]
        pixels = (self._project(shape) + 0.5) * fine - 0.5
        return rasterise(pixels, shape[:, 2], self.triangles, size=(self.size[0] * fine, self.size[1] * fine))

    def _hit(self, points: Floats, index: int) -> tuple[Ints, Floats]:
        """Return triangle corners and barycentric weights of points on the surface, each `(N, 3)`; NaN weights off the surface."""
        fine = 4
        surface = self._surface(index, fine)
        column, row = np.round((np.asarray(points) + 0.5) * fine - 0.5).astype(int).T
        inside = (column >= 0) & (row >= 0) & (column < self.size[0] * fine) & (row < self.size[1] * fine)
        triangle = np.where(inside, surface.triangle[row * inside, column * inside], -1)
        corner = self.triangles[np.maximum(triangle, 0)]
        shape = self.shapes[index]
        at = self._project(shape)[corner]
        first, second, offset = at[:, 1] - at[:, 0], at[:, 2] - at[:, 0], np.asarray(points) - at[:, 0]
        det = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
        u = (offset[:, 0] * second[:, 1] - offset[:, 1] * second[:, 0]) / det
        v = (first[:, 0] * offset[:, 1] - first[:, 1] * offset[:, 0]) / det
        weights = np.stack([1 - u - v, u, v], axis=1) / shape[corner, 2]
        weights /= weights.sum(axis=1, keepdims=True)
        weights[triangle < 0] = np.nan
        return corner, weights

    def _sees(self, pixels: Floats, depth: Floats, index: int) -> NDArray[np.bool_]:
        known = np.isfinite(depth)
        column, row = np.round(np.where(known[:, None], pixels, -1)).astype(int).T
        inside = (column >= 0) & (row >= 0) & (column < self.size[0]) & (row < self.size[1])
        nearest = self._surface(index, 1).depth[row * inside, column * inside]
        radius = np.ptp(self.shapes[0, :, 1]) / 2
        seen = inside & (depth <= nearest + LAYER * radius)
        if self.occluder:
            left, right = self._bar(index)
            seen &= (pixels[:, 0] < left) | (pixels[:, 0] > right)
        return np.asarray(seen)

    def _bar(self, index: int) -> tuple[float, float]:
        """Return the occluder's left and right edge, pixels: it crosses the image once, in the last two thirds of the film."""
        time = (index / max(self.num_frames - 1, 1) - 0.33) / 0.67
        left = -0.2 * self.size[0] + 1.2 * self.size[0] * time
        return left, left + 0.15 * self.size[0]


def render_film(
    sequence: Sequence,
    *,
    size: tuple[int, int] = (640, 480),
    fill: float = 0.75,
    distance: float = 6.0,
    blur: float = 0.6,
    noise: float = 2.0,
    paint: ArrayLike | None = None,
    occluder: bool = False,
    seed: int = 0,
) -> RenderedFilm:
    """Place a gallery sequence in front of a pinhole camera.

    Parameters
    ----------
    sequence
        From `pliant.solver.gallery`; its cameras turn the object.
    size
        Width and height in pixels.
    fill
        Share of the image's width or height that the object spans at most.
    distance
        From the camera to the object's centre, in half heights of the object.
    blur
        Standard deviation of the lens blur in pixels.
    noise
        Standard deviation of the noise in grey levels (0–255).
    paint
        Colour of every vertex, shape `(P, 3)`, grey levels; `paint.face_paint` colours the gallery's face. None: the texture alone.
    occluder
        Whether a textured bar passes in front of the object once.
    seed
        Seed of texture, background and noise.
    """
    turned = sequence.shapes @ sequence.rotations.transpose(0, 2, 1)
    radius = np.abs(turned[..., 1]).max()
    shapes = turned + np.array([0.0, 0.0, distance * radius])
    slopes = np.abs(shapes[..., :2] / shapes[..., 2:]).max(axis=(0, 1))
    focal = float((fill * np.array(size) / 2 / slopes).min())
    rest = sequence.shapes[0] * (focal / (distance * radius))
    colours = None if paint is None else np.asarray(paint, dtype=np.float64)
    return RenderedFilm(
        size,
        focal,
        shapes,
        triangles_of(sequence.mesh.faces).astype(np.int64),
        rest,
        blur,
        noise,
        colours,
        occluder,
        seed,
    )


def texture(points: Floats, height: int, seed: int) -> Floats:
    """Evaluate a solid texture, soft-clipped sums of plane waves, at positions `(N, 3)` in pixels; return grey levels `(N, 3)`."""
    random = np.random.default_rng(seed)
    direction = random.standard_normal((WAVES, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    wavelength = np.exp(random.uniform(np.log(FINEST), np.log(COARSEST * height), WAVES))
    phase = random.uniform(0, 2 * np.pi, WAVES)
    shared = random.standard_normal((WAVES, 1)) + 0.3 * random.standard_normal((WAVES, 3))
    strength = shared * wavelength[:, None] ** 0.5
    waves = np.cos((points @ (direction * (2 * np.pi / wavelength)[:, None]).T + phase).astype(np.float32))
    level = waves @ (strength / np.linalg.norm(strength, axis=0)).astype(np.float32)
    return np.asarray(127.5 + 100 * np.tanh(1.2 * level), dtype=np.float64)
