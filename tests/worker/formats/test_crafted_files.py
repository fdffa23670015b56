"""The crafted files of `attack_files`, given to the readers without a service; tests/service sends ten of them over HTTP."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import pytest
from attack_files import ATTACKS, OVER_HTTP, Attack
from crafting import CANARY, HONEST
from pliant.schemas.film_limits import FilmLimits
from pliant.schemas.options import Options
from pliant.solver import InvalidInput
from pliant.worker.films.bounds import FilmBounds
from pliant.worker.films.sources import FilmSource
from pliant.worker.films.tracker import read_film
from pliant.worker.formats import store_inputs

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("forked_readers")]


@pytest.mark.parametrize("attack", [each for each in ATTACKS if each.name not in OVER_HTTP], ids=str)
def test_a_crafted_file_is_refused_by_its_reader(attack: Attack, tmp_path: Path) -> None:
    crafted, honest = tmp_path / "crafted", tmp_path / "tracks.npy"
    crafted.write_bytes(attack.make())
    honest.write_bytes(HONEST)
    options = Options.model_validate_json(attack.texts.get("options", "{}"))
    given: dict[str, Path | str] = {"tracks": honest, **attack.texts, attack.part: crafted}
    given.pop("options", None)
    read = (
        partial(
            read_film, FilmSource(crafted, None), options, FilmBounds(limits=FilmLimits(bytes=attack.limits.max_bytes))
        )
        if attack.part == "film"
        else partial(store_inputs, **given, options=options, limits=attack.limits, target=tmp_path / "inputs.npz")  # type: ignore[arg-type]
    )
    with pytest.raises(InvalidInput) as caught:
        read()
    assert caught.value.code in attack.codes, caught.value
    assert caught.value.hint
    assert not CANARY.exists()
    assert not (tmp_path / "inputs.npz").exists()
