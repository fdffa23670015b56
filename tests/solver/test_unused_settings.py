"""Settings without effect: the shapes are the same to the bit, and a warning names the setting and the reason."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pliant.solver import KnownCamera, Settings, Solution, Tracks, gallery, solve
from pliant.solver.reconstruction.unused_settings import combinations, without_effect

WARNINGS = Path(__file__).parents[2] / "docs" / "reference" / "warnings.md"
OTHER: dict[str, Any] = {
    "method": "temporal", "preset": "paper", "prior": "smooth", "loss": "huber", "laplacian": "uniform", "temporal_weight": 7.0,
    "spatial_weight": 7.0, "low_rank_weight": 7.0, "robust_scale": 0.5, "temporal_order": 2, "precision": "float32",
    "max_reweightings": 1, "tolerance": 0.3, "basis_size": 2, "refine_rotations": False, "principal_point": (5.0, 7.0),
}  # fmt: skip
"""A value for each setting that differs from the default and has an effect on its own."""
COMBINED: list[tuple[dict[str, Any], str]] = [
    ({"method": "pseudo_inverse"}, "with method pseudo_inverse"),
    ({"method": "temporal"}, "with method temporal"),
    ({"method": "spatio_temporal"}, "with method spatio_temporal"),
    ({}, "with prior gaussian"),
    ({"prior": "smooth"}, "with prior smooth"),
    ({"prior": "smooth+low_rank", "preset": "paper"}, "with preset paper without low_rank_weight"),
    ({"prior": "smooth", "loss": "l2"}, "with loss l2"),
    ({"prior": "smooth", "camera": "orthographic"}, "with camera orthographic"),
    ({"prior": "smooth", "camera": "scaled_orthographic"}, "with camera scaled_orthographic"),
    ({"prior": "smooth"}, "with camera auto, which finds perspective only with prior gaussian"),
    ({"prior": "smooth"}, "without a mesh"),
    ({"prior": "smooth"}, "with given rotations"),
]


@pytest.fixture(scope="module")
def face() -> gallery.Sequence:
    return gallery.face(6, 60)


def solved(face: gallery.Sequence, *, mesh: bool, known: bool = True, **settings: Any) -> Solution:
    rng = np.random.default_rng(0)
    noisy = Tracks.from_arrays(face.tracks.points + rng.normal(0, 0.01, face.tracks.points.shape))
    cameras = KnownCamera.from_arrays(face.rotations, face.scales)
    return solve(noisy, face.mesh if mesh else None, cameras=cameras if known else None, settings=Settings(**settings))


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        pytest.param(settings, reason, id=reason, marks=[] if settings else pytest.mark.slow)
        for settings, reason in COMBINED
    ],
)
def test_settings_without_effect_change_no_bit_and_are_reported(
    face: gallery.Sequence, settings: dict[str, Any], reason: str
) -> None:
    mesh, known = reason != "without a mesh", not reason.startswith("with camera auto")
    named = {
        name
        for why, names in combinations(Settings(**settings), with_mesh=mesh, known_cameras=known, isometric=False)
        for name in names
        if why == reason
    }
    assert named
    kept = {name: value for name, value in settings.items() if name not in named}
    plain = solved(face, mesh=mesh, known=known, **kept)
    for name in named:
        given = solved(face, mesh=mesh, known=known, **{**settings, name: settings.get(name, OTHER[name])})
        assert f"{name} has no effect {reason}." in given.choices.warnings
        np.testing.assert_array_equal(given.shapes, plain.shapes)


@pytest.mark.parametrize(
    "settings",
    [
        {
            "prior": "smooth",
            "loss": "huber",
            "robust_scale": 0.5,
            "temporal_weight": 7.0,
            "spatial_weight": 7.0,
            "laplacian": "uniform",
        },
        {"prior": "smooth", "temporal_order": 2, "precision": "float32"},
        {"prior": "smooth+low_rank", "low_rank_weight": 7.0, "preset": "paper"},
        {"method": "temporal", "prior": "smooth+low_rank", "max_reweightings": 1, "tolerance": 0.3},
    ],
)
def test_settings_with_an_effect_are_not_reported(face: gallery.Sequence, settings: dict[str, Any]) -> None:
    solution = solved(face, mesh=True, **settings)
    assert not any("no effect" in each for each in solution.choices.warnings)
    kept = {name: value for name, value in settings.items() if name in ("method", "prior", "preset")}
    plain = solved(face, mesh=True, **kept)
    for name in settings.keys() - kept.keys():
        with_it = solved(face, mesh=True, **{**kept, name: settings[name]})
        assert not np.array_equal(with_it.shapes, plain.shapes), name


def test_an_isometric_surface_uses_only_the_lens() -> None:
    names = {each.name for each in fields(Settings)}
    used = {"camera", "focal", "field_of_view", "principal_point", "image_size", "y_up", "surface", "order", "seed"}
    warnings = without_effect(Settings(**{name: OTHER[name] for name in names - used}), isometric=True)
    assert {each.removesuffix(" has no effect with an isometric surface.") for each in warnings} == names - used


def test_every_combination_is_documented() -> None:
    text = WARNINGS.read_text(encoding="utf-8")
    every = [Settings(**settings) for settings, _ in COMBINED]
    found = {
        (reason, name)
        for each in every
        for isometric in (True, False)
        for known in (True, False)
        for reason, names in combinations(each, with_mesh=False, known_cameras=known, isometric=isometric)
        for name in names
    }
    rows = dict(
        line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith(("| with ", "| without "))
    )
    for reason, name in found:
        assert f"`{name}`" in rows[reason.replace("scaled_orthographic", "orthographic")], (reason, name)
