"""Films to dense tracks: what a film shows of a surface, as points that can be reconstructed.

    from pliant.tracking import track_film

    tracked = track_film("face.mp4", region="mask.png")
    tracked.save_npz("tracks.npz")

Needs OpenCV: `pip install 'pliant[film]'`.
"""

if __name__ != "pliant.tracking":
    raise ImportError(f"import this folder as pliant.tracking, not as {__name__!r}: install it with pip install -e .")

try:
    import cv2 as _cv2
except ImportError as error:
    raise ImportError("Tracking films needs OpenCV. Install it with: pip install 'pliant[film]'") from error

from pliant.tracking.decoding.film import Film, Frame, open_film
from pliant.tracking.decoding.limits import FilmLimits
from pliant.tracking.errors import FilmError, TrackingError, TrackingStopped
from pliant.tracking.records import FilmInfo, OnStep, TrackedFilm, TrackingStep
from pliant.tracking.track import track_film

del _cv2

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
