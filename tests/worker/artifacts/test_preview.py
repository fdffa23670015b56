"""preview.bin read back by the layout in its docstring, independently of the writer."""

from __future__ import annotations

import io
import json
import struct
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from pliant.solver import Camera, Mesh, Solution, Tracks
from pliant.solver.evaluation.alignment import align
from pliant.solver.gallery import Sequence, corrupt, face
from pliant.solver.mesh import triangles_of
from pliant.worker.artifacts import preview
from pliant.worker.formats.texture import Texture
from results import preview_of

F, P = 6, 60


@pytest.fixture(scope="module")
def sequence() -> Sequence:
    return corrupt(face(F, P, scale_change=0.2), noise=0.01, hidden=0.2, seed=3)


def solution_of(sequence: Sequence, *, mirrored: bool = False) -> Solution:
    """The truth itself as a solution, or its bas-relief mirror, which fits the tracks equally well."""
    flip = np.diag([1.0, 1.0, -1.0 if mirrored else 1.0])
    shapes = (sequence.shapes - sequence.shapes.mean(axis=1, keepdims=True)) @ flip
    rotations = flip @ sequence.rotations @ flip
    seen = sequence.tracks.visible > 0
    free = sequence.tracks.points - sequence.scales[:, None, None] * shapes @ rotations[:, :2].transpose(0, 2, 1)
    translations = np.array([free[f][seen[f]].mean(axis=0) for f in range(len(shapes))])
    camera = Camera(rotations, sequence.scales, translations)
    # The writer reads nothing else of a solution.
    rest: dict[str, Any] = dict.fromkeys(("residuals", "trace", "outcome", "choices", "seconds"))
    return Solution(shapes=shapes, camera=camera, weights=seen.astype(float), **rest)


def read(raw: bytes) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    assert raw[:8] == b"PLIANTPV"
    version, length = struct.unpack_from("<II", raw, 8)
    assert version == 1
    header = json.loads(raw[16 : 16 + length])
    frames, points = header["num_frames"], header["num_points"]
    kinds = {
        "faces": ("<u4", (-1, 3)),
        "cameras": ("<f4", (frames, 10)),
        "positions": ("<i2", (frames, points, 3)),
        "residuals": ("<i2", (frames, points, 2)),
        "truth": ("<i2", (frames, points, 3)),
        "frames": ("<f4", (frames, 6)),
        "points": ("<u4", (points, 2)),
        "spread": ("<u2", (frames, points)),
        "rejected": ("u1", (frames, -1)),
        "times": ("<f4", (frames,)),
        "places": ("<f4", (points, 2)),
        "picture": ("u1", (-1,)),
    }
    arrays = {}
    for name, section in header["sections"].items():
        assert section["offset"] % 8 == 0
        kind, shape = kinds[name]
        part = raw[section["offset"] : section["offset"] + section["bytes"]]
        arrays[name] = np.frombuffer(part, kind).reshape(shape)
    return header, arrays


def world(header: dict[str, Any], values: NDArray[Any]) -> NDArray[np.float64]:
    return np.array(header["origin"]) + header["step"] * values


def test_positions_round_trip_within_half_a_quantization_step(sequence: Sequence) -> None:
    solution = solution_of(sequence)
    raw = preview_of(sequence.tracks, solution, mesh=sequence.mesh, y_axis="up", fps=12)
    header, arrays = read(raw)
    error = np.abs(world(header, arrays["positions"]) - solution.shapes).max()
    assert 0 < error <= 0.5001 * header["step"]
    assert header["step"] < np.ptp(solution.shapes) / 60_000
    assert (header["y_axis"], header["fps"], header["frame_stride"]) == ("up", 12, 1)
    np.testing.assert_allclose(arrays["cameras"][:, :9].reshape(-1, 3, 3), solution.camera.rotations, atol=1e-7)
    np.testing.assert_allclose(arrays["cameras"][:, 9], solution.camera.scales, rtol=1e-6)
    assert "truth" not in arrays


def test_projections_plus_residuals_give_the_tracks(sequence: Sequence) -> None:
    solution = solution_of(sequence)
    raw = preview_of(sequence.tracks, solution)
    header, arrays = read(raw)
    hidden = sequence.tracks.visible == 0
    assert (arrays["residuals"][hidden] == -32768).all()
    assert (arrays["residuals"][~hidden] > -32768).all()
    table, positions = arrays["cameras"].astype(float), world(header, arrays["positions"])
    flat = np.einsum("fpj,fij->fpi", positions, table[:, :9].reshape(-1, 3, 3)[:, :2]) * table[:, 9, None, None]
    tracks = flat + solution.camera.translations[:, None] + header["residual_step"] * arrays["residuals"]
    assert np.abs(tracks - sequence.tracks.points)[~hidden].max() < 2 * (header["residual_step"] + header["step"])
    assert header["num_faces"] == 0


@pytest.mark.parametrize(("mirrored", "unit"), [(False, 1.0), (True, 1000.0)])
def test_truth_is_aligned_and_scaled_to_the_result(sequence: Sequence, mirrored: bool, unit: float) -> None:
    turned = sequence.shapes @ np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0] + 5.0
    if (
        np.linalg.det(
            np.linalg.lstsq(sequence.shapes[0] - sequence.shapes[0].mean(0), turned[0] - turned[0].mean(0))[0]
        )
        < 0
    ):
        turned = turned * (1.0, 1.0, -1.0)
    truth = turned + np.random.default_rng(2).normal(scale=2.0, size=turned.shape)
    truth[:, 7] = np.nan
    truth *= unit
    solution = solution_of(sequence, mirrored=mirrored)
    raw = preview_of(sequence.tracks, solution, mesh=sequence.mesh, truth=truth)
    header, arrays = read(raw)
    assert header["mirrored"] is mirrored
    known = np.arange(P) != 7
    apart = np.linalg.norm(world(header, arrays["truth"]) - world(header, arrays["positions"]), axis=2)
    expected = align(solution.shapes[:, known], truth[:, known], kind="frame_scaled")
    np.testing.assert_allclose(apart[:, known], expected.distances / expected.scales[0], atol=2 * header["step"])
    assert (apart[:, 7] == 0).all()


def test_a_result_without_extent_shows_no_truth(sequence: Sequence) -> None:
    solution = replace(solution_of(sequence), shapes=np.zeros_like(sequence.shapes))
    raw = preview_of(sequence.tracks, solution, truth=sequence.shapes)
    _, arrays = read(raw)
    assert "truth" not in arrays


def test_tables_hold_visibility_rejections_and_uncertainty(sequence: Sequence) -> None:
    exact = solution_of(sequence)
    seen = sequence.tracks.visible > 0
    weights = seen.astype(float)
    weights[2, np.flatnonzero(seen[2])[:5]] = 0
    std = np.random.default_rng(4).uniform(0.1, 2.0, size=(F, P))
    solution = replace(exact, weights=weights, shapes_std=std)
    raw = preview_of(sequence.tracks, solution, truth=sequence.shapes, image_size="320x240")
    header, arrays = read(raw)
    assert (header["all_frames"], header["image_size"]) == (F, [320, 240])
    np.testing.assert_array_equal(arrays["points"][:, 0], seen.sum(axis=0))
    rejected = np.unpackbits(arrays["rejected"], axis=1, count=P, bitorder="little").astype(bool)
    np.testing.assert_array_equal(rejected, seen & (weights == 0))
    assert rejected.sum() == 5
    np.testing.assert_array_equal(arrays["points"][:, 1], rejected.sum(axis=0))
    np.testing.assert_allclose(header["spread_step"] * arrays["spread"], std, atol=0.51 * header["spread_step"])
    table = arrays["frames"]
    np.testing.assert_allclose(table[:, :2], exact.camera.translations, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(table[:, 2], 1 - seen.mean(axis=1), atol=1e-6)
    np.testing.assert_allclose(table[:, 3] * header["size"], np.sqrt((std**2).mean(axis=1)), rtol=1e-5)
    assert table[:, 4].max() < 1e-6


def test_columns_are_nan_without_posterior_and_truth(sequence: Sequence) -> None:
    raw = preview_of(sequence.tracks, solution_of(sequence))
    header, arrays = read(raw)
    assert "spread" not in header["sections"]
    assert np.isnan(arrays["frames"][:, 3:5]).all()
    assert np.isfinite(arrays["frames"][:, 5]).all()


def test_truth_of_too_few_points_is_omitted(sequence: Sequence) -> None:
    truth = np.full((F, P, 3), np.nan)
    truth[:, :2] = 1.0
    raw = preview_of(sequence.tracks, solution_of(sequence), truth=truth)
    assert "truth" not in read(raw)[0]["sections"]


def test_a_long_sequence_is_subsampled_evenly_and_keeps_its_speed(
    sequence: Sequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(preview, "MOST_OBSERVATIONS", F * P // 2)
    solution = solution_of(sequence)
    raw = preview_of(sequence.tracks, solution, fps=30, frame_times=np.arange(F) ** 2 / 150)
    header, arrays = read(raw)
    assert (header["num_frames"], header["frame_stride"], header["fps"]) == (3, 2, 15)
    np.testing.assert_allclose(world(header, arrays["positions"]), solution.shapes[::2], atol=header["step"])
    np.testing.assert_allclose(arrays["times"], np.array([0, 4, 16]) / 150, rtol=1e-6)


def test_quads_become_triangles_of_the_same_orientation() -> None:
    mesh = Mesh.from_grid(np.arange(6).reshape(2, 3))
    found = triangles_of(mesh.faces)
    assert found.shape == (4, 3)
    plane = np.array([(x, y, 0.0) for y in range(2) for x in range(3)])
    normals = np.cross(plane[found[:, 1]] - plane[found[:, 0]], plane[found[:, 2]] - plane[found[:, 0]])
    assert len({float(z) for z in normals[:, 2]}) == 1


def test_a_perfect_fit_has_a_positive_residual_step() -> None:
    sequence = face(3, 12)
    exact = solution_of(sequence)
    projected = exact.camera.scales[:, None, None] * exact.shapes @ exact.camera.rotations[:, :2].transpose(0, 2, 1)
    tracks = Tracks.from_arrays(projected + exact.camera.translations[:, None])
    raw = preview_of(tracks, exact)
    header, arrays = read(raw)
    assert header["residual_step"] > 0
    assert np.abs(header["residual_step"] * arrays["residuals"]).max() < 1e-9


def test_a_films_picture_and_texture_coordinates_round_trip(sequence: Sequence) -> None:
    places = np.random.default_rng(0).random((P, 2))
    texture = Texture.from_tracked(np.full((8, 10, 3), (200, 90, 30), dtype=np.uint8), places)
    raw = preview_of(sequence.tracks, solution_of(sequence), mesh=sequence.mesh, texture=texture)
    _, arrays = read(raw)
    np.testing.assert_array_equal(arrays["places"], places.astype("<f4"))
    with Image.open(io.BytesIO(arrays["picture"].tobytes())) as picture:
        assert (picture.format, picture.size) == ("JPEG", (10, 8))
        np.testing.assert_allclose(picture.getpixel((5, 4)), (200, 90, 30), atol=6)
