"""Notes on options that are only for films or only for tracks."""

from __future__ import annotations

from pliant.schemas.options import Options

ONLY_FILMS = ("grid_step", "longest_side", "region_frame", "region_polygon", "template_frame")
ONLY_TRACKS = ("coordinate_order", "coordinates", "layout", "rows", "visibility", "y_axis")


def notes_on_options(options: Options, *, film: bool) -> list[str]:
    """Return a note that lists the given options that are only for the other kind of input; empty if there are none."""
    default = Options()
    others = ONLY_TRACKS if film else ONLY_FILMS
    given = [name for name in others if getattr(options, name) != getattr(default, name)]
    if not given:
        return []
    return [f"Not used for {'films' if film else 'tracks'}: {', '.join(given)}."]
