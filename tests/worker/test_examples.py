"""The built-in examples are readable inputs and reproducible."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageDraw
from pliant.schemas.options import Options
from pliant.worker.errors import UnknownExample
from pliant.worker.examples import EXAMPLES, example_file
from pliant.worker.films import example as example_film
from pliant.worker.formats import read_inputs


@pytest.mark.parametrize("name", sorted(EXAMPLES))
def test_every_example_is_read_as_described(name: str, tmp_path: Path) -> None:
    parts = {}
    for part, file in EXAMPLES[name].files:
        parts[part] = tmp_path / file
        parts[part].write_bytes(example_file(name, file))
    inputs = read_inputs(
        tracks=parts["tracks"], mesh=parts["mesh"], ground_truth=parts["ground_truth"], options=Options()
    )
    made = EXAMPLES[name].make()
    assert inputs.interpretation.has_ground_truth
    assert inputs.interpretation.mesh_source == "given"
    assert inputs.interpretation.num_faces == len(made.mesh.faces)
    seen = made.tracks.visible > 0
    np.testing.assert_array_equal(inputs.tracks.visible > 0, seen)
    np.testing.assert_allclose(inputs.tracks.points[seen], made.tracks.points[seen], atol=1e-4)
    assert inputs.ground_truth is not None
    np.testing.assert_allclose(inputs.ground_truth.shapes, made.shapes, atol=1e-4)


def test_an_example_file_has_the_same_bytes_every_time() -> None:
    assert example_file("flag", "tracks.npz") == example_file("flag", "tracks.npz")


@pytest.mark.parametrize(
    ("name", "file"), [("absent", "tracks.npz"), ("face", "absent.npz"), ("face", "../tracks.npz")]
)
def test_the_error_for_an_unknown_example_lists_the_known_ones(name: str, file: str) -> None:
    with pytest.raises(UnknownExample, match=r"There are: face/tracks\.npz, face/mesh\.npz.*, film/face\.webm\."):
        example_file(name, file)


@pytest.mark.slow
def test_the_example_film_shows_a_face_inside_its_region(tmp_path: Path) -> None:
    pytest.importorskip("cv2")
    from pliant.tracking import open_film

    target = tmp_path / "face.webm"
    target.write_bytes(example_file("film", "face.webm"))
    frames = [frame.image.astype(float) for frame in open_film(target).frames()]
    assert len(frames) == 30
    corners = np.array(example_film.region())
    assert frames[0].shape[:2] == (360, 480)
    inside = Image.new("1", (480, 360))
    ImageDraw.Draw(inside).polygon([(float(x), float(y)) for x, y in corners], fill=1)
    face_, around = frames[0][np.asarray(inside)], frames[0][~np.asarray(inside)]
    assert face_.std() > 4 * around.std()  # a pattern before a plain background
    assert np.abs(frames[29] - frames[0])[np.asarray(inside)].mean() > 10  # it turns
    assert example_film.film() is example_film.film()
