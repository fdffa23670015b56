"""Synthetic example inputs: the list, and the files."""

from __future__ import annotations

from typing import Annotated

from fastapi import Path, Request
from fastapi.responses import Response
from pliant.schemas.job import Record
from pliant.service.openapi import problems
from pliant.service.routes.router import Router
from pliant.worker.examples import EXAMPLES, example_file
from pliant.worker.films import example as example_film
from pydantic import Field

router = Router(prefix="/v1/examples", tags=["about"])

Name = Annotated[str, Path(description="An example's name.", examples=["face"])]
File = Annotated[str, Path(description="One of its files.", examples=["tracks.npz"])]


class ExampleFile(Record):
    """One input file of an example."""

    part: str = Field(description="Name of the form part for this file.")
    file: str = Field(description="Its name.")
    url: str = Field(description="Its address, relative to the service.")


class Example(Record):
    """A synthetic sequence with ground truth, or a rendered film."""

    name: str = Field(description="Its name in addresses.")
    title: str = Field(description="What it shows, in a few words.")
    files: list[ExampleFile] = Field(description="Input files, one for each form part.")
    region_polygon: list[tuple[float, float]] | None = Field(
        None,
        description="Outline of the object in a film's first frame, for the option of the same name; null for tracks.",
    )


class Examples(Record):
    """All examples."""

    examples: list[Example] = Field(description="Every example that this installation can run.")


@router.get("", operation_id="list_examples", summary="List example inputs", responses=problems(401))
def examples(request: Request) -> Examples:
    """Return synthetic sequences and films whose files can be sent as the parts of a job."""
    return Examples(
        examples=[
            Example(
                name=one.name,
                title=one.title,
                files=[
                    ExampleFile(
                        part=part, file=file, url=str(request.app.url_path_for("example", name=one.name, file=file))
                    )
                    for part, file in one.files
                ],
            )
            for one in EXAMPLES.values()
        ]
        + _films(request)
    )


def _films(request: Request) -> list[Example]:
    """Return the example film, if this installation can track films."""
    if not example_film.available():
        return []
    name, file = example_film.NAME, example_film.FILE
    url = str(request.app.url_path_for("example", name=name, file=file))
    files = [ExampleFile(part="film", file=file, url=url)]
    return [Example(name=name, title=example_film.TITLE, files=files, region_polygon=list(example_film.region()))]


@router.get(
    "/{name}/{file}",
    operation_id="get_example_file",
    summary="A file of an example",
    response_class=Response,
    responses={200: {"content": {"application/octet-stream": {}}}, **problems(401, 404)},
)
def example(name: Name, file: File) -> Response:
    """Return an input file; its bytes never change."""
    return Response(
        example_file(name, file),
        media_type="application/octet-stream",
        headers={"Content-Disposition": f'attachment; filename="{file}"', "Cache-Control": "private, max-age=3600"},
    )
