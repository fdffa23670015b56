"""report.json: how a result was computed."""

from __future__ import annotations

import math
import platform
import sys
from collections.abc import Mapping
from dataclasses import asdict
from functools import cache
from importlib.metadata import version
from typing import Any

from pliant.schemas.options import Options
from pliant.solver import Solution
from pliant.solver.evaluation.trust import Trust
from pliant.solver.records import Floats
from pliant.worker.formats import Inputs

REPORT_VERSION = 1


def build_report(
    inputs: Inputs,
    solution: Solution,
    options: Options,
    *,
    metrics: Mapping[str, float],
    seconds: Mapping[str, float] | None = None,
    name: str = "",
) -> dict[str, Any]:
    """Return the content of `report.json` as plain values for JSON.

    Metrics that are not finite are written as null. `seconds` are of stages outside the solver, e.g. `loading`.
    """
    choices = asdict(solution.choices)
    reasons, warnings = choices.pop("reasons"), choices.pop("warnings")
    for elsewhere in ("camera", "depth_sign", "focal_candidates"):
        del choices[elsewhere]  # in the section `camera`
    report = {
        "report_version": REPORT_VERSION,
        "name": name,
        **_trust(solution.trust),
        "outcome": solution.outcome.value,
        "sentence": solution.outcome.sentence,
        "warnings": list(warnings),
        "metrics": dict(metrics),
        "choices": {
            each: {"value": value} | ({"reason": reasons[each]} if each in reasons else {})
            for each, value in choices.items()
        },
        "reasons": reasons,
        "camera": described_camera(solution, options),
        "options": options.model_dump(mode="json"),
        "interpretation": inputs.interpretation.model_dump(mode="json"),
        "trace": {
            "objective": solution.trace.objective.tolist(),
            "residual": solution.trace.residual.tolist(),
            "iterations": solution.trace.iterations.tolist(),
        },
        "seconds": {**(seconds or {}), **solution.seconds},
        "peak_memory_bytes": peak_memory(),
        "versions": versions(),
    }
    plain: dict[str, Any] = _plain(report)
    return plain


def described_camera(solution: Solution, options: Options) -> dict[str, Any]:
    """Return the camera properties common to all frames: model, lens, how they were chosen, and a sentence.

    The horizontal field of view of a picture W wide is 2 atan(W / 2φ), in degrees; its standard deviation is that of φ times |dθ/dφ|.
    """
    camera, choices = solution.camera, solution.choices
    angle, angle_std = None, None
    if camera.focal is not None and options.picture_size is not None:
        half = options.picture_size[0] / 2
        angle = math.degrees(2 * math.atan2(half, camera.focal))
        if camera.focal_std is not None:
            angle_std = math.degrees(2 * half / (camera.focal**2 + half**2)) * camera.focal_std
    return {
        "model": choices.camera,
        "focal": camera.focal,
        "focal_std": camera.focal_std,
        "field_of_view": angle,
        "field_of_view_std": angle_std,
        "sentence": _lens_sentence(choices.camera, camera.focal, camera.focal_std, angle, angle_std)
        + _size_sentence(camera.scales),
        "principal_point": camera.principal_point.tolist(),
        "depth_sign": choices.depth_sign,
        "candidates": [asdict(each) for each in choices.focal_candidates],
        "reason": choices.reasons.get("camera_model"),
    }


def _lens_sentence(
    model: str, focal: float | None, focal_std: float | None, angle: float | None, angle_std: float | None
) -> str:
    name = model.replace("_", " ").capitalize()
    if focal is None:
        return f"{name} camera."
    known = " (given)" if focal_std == 0 else "" if focal_std is None else f" ± {_two_digits(focal_std)}"
    view = "" if angle is None else f", horizontal field of view {angle:.1f}°"
    view += "" if angle is None or not angle_std else f" ± {_two_digits(angle_std)}°"
    return f"{name} camera, focal length {float(f'{focal:.4g}'):g} px{known}{view}."


def _size_sentence(scales: Floats) -> str:
    """Return how much the scales differ between frames, with a space before it; empty below 1 %."""
    change = round(100 * (float(scales.max() / scales.min()) - 1))
    if change < 1:
        return ""
    return (
        f" The object's size in the picture changes by {change} %. This is read as a change of the camera's distance; "
        "a growing or shrinking object looks the same."
    )


def _trust(trust: Trust | None) -> dict[str, Any]:
    """Return the verdict on the result with its reasons; nulls if the solver gave none."""
    if trust is None:
        trust_fields = ("verdict", "expected_error", "expected_error_interval", "trust_sentence", *_TRUST_FIGURES)
        return {**dict.fromkeys(trust_fields), "verdict_reasons": []}
    return {
        "verdict": trust.verdict.value,
        "verdict_reasons": list(trust.reasons),
        "expected_error": trust.expected_error,
        "expected_error_interval": None if trust.interval is None else list(trust.interval),
        "trust_sentence": trust.sentence,
        **{name: getattr(trust, name) for name in _TRUST_FIGURES},
    }


_TRUST_FIGURES = ("turn_degrees", "degrees_per_frame", "deformation_per_frame", "held_out_error")
"""Figures of `Trust` reported under their own names, besides those of the verdict; the report has the others already."""


def peak_memory() -> int | None:
    """Return the peak resident size of this process, bytes; None on Windows."""
    try:
        import resource
    except ModuleNotFoundError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def versions() -> dict[str, str]:
    """Return the versions of the software used."""
    return {**_libraries(), "python": platform.python_version(), "system": f"{platform.system()} {platform.machine()}"}


@cache
def _libraries() -> dict[str, str]:
    """Read versions once: SciPy's metadata alone takes 5 ms."""
    return {name: version(name) for name in ("pliant", "numpy", "scipy")}


def _plain(value: Any) -> Any:
    """Convert to plain values for JSON; NaN and infinity, which JSON lacks, become None."""
    if isinstance(value, Mapping):
        return {str(name): _plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    plain = value.item() if hasattr(value, "item") else value
    return None if isinstance(plain, float) and not math.isfinite(plain) else plain


def _two_digits(value: float) -> str:
    """Round to two digits and write them without an exponent below a million."""
    return f"{float(f'{value:.2g}'):g}"
