"""Dense point tracks from films, ready for reconstruction.

    from pliant.tracking import track_film

    tracked = track_film("face.mp4", region="mask.png")
    tracked.save_npz("tracks.npz")

Needs OpenCV, the extra `film`: `pip install '.[film]'` in Pliant's source folder. Names are imported on first access, so that
opening a film does not load the tracker.
"""

if __name__ != "pliant.tracking":
    raise ImportError(f"import this folder as pliant.tracking, not as {__name__!r}: install it with pip install -e .")

try:
    import cv2 as _cv2
except ImportError as error:
    raise ImportError(
        "Tracking films needs OpenCV. Install the extra film: pip install '.[film]' in Pliant's source folder"
    ) from error

from importlib import import_module
from typing import TYPE_CHECKING

from pliant.schemas.film_limits import FilmLimits

if TYPE_CHECKING:
    from pliant.tracking.decoding.film import Film, Frame, open_film
    from pliant.tracking.errors import FilmError, TrackingError, TrackingStopped
    from pliant.tracking.records import FilmInfo, OnStep, TrackedFilm, TrackingStep
    from pliant.tracking.track import track_film

del _cv2

_HOMES = {
    "decoding.film": ("Film", "Frame", "open_film"),
    "errors": ("FilmError", "TrackingError", "TrackingStopped"),
    "records": ("FilmInfo", "OnStep", "TrackedFilm", "TrackingStep"),
    "track": ("track_film",),
}
_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}

__all__ = [
    "Film",
    "FilmError",
    "FilmInfo",
    "FilmLimits",
    "Frame",
    "OnStep",
    "TrackedFilm",
    "TrackingError",
    "TrackingStep",
    "TrackingStopped",
    "open_film",
    "track_film",
]


def __getattr__(name: str) -> object:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'pliant.tracking' has no attribute {name!r}")
    return getattr(import_module(f"pliant.tracking.{_HOME_OF[name]}"), name)
