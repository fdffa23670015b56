"""Notes on options that this job does not use."""

from __future__ import annotations

from pliant.schemas.options import Options

ONLY_FILMS = ("grid_step", "longest_side", "region_frame", "region_polygon", "template_frame")
ONLY_TRACKS = ("coordinate_order", "coordinates", "layout", "rows", "visibility", "y_axis")

OF_FILES = {
    "axes": {"obj", "ply"},
    "colours": {"glb", "obj", "ply", "usd"},
    "glb_motion": {"glb"},
    "glb_quantized": {"glb"},
    "normals": {"glb", "obj", "ply", "usd"},
}
"""Options that change result files, and the `outputs` that they change."""


def notes_on_options(options: Options, *, film: bool) -> list[str]:
    """Return notes that list the given options that belong to the other kind of input, or to files that are not written."""
    others = ONLY_TRACKS if film else ONLY_FILMS
    of_files = [name for name, outputs in OF_FILES.items() if outputs.isdisjoint(options.outputs)]
    unused = {
        f"Not used for {'films' if film else 'tracks'}": others,
        f"Not used with outputs {','.join(options.outputs)}": of_files,
    }
    default, notes = Options(), []
    for why, names in unused.items():
        given = [name for name in names if getattr(options, name) != getattr(default, name)]
        if given:
            notes.append(f"{why}: {', '.join(given)}.")
    return notes
