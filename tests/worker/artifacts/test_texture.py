"""Textures and point caches, each read back with another library."""

from __future__ import annotations

import io
import struct
import warnings
import zipfile
from pathlib import Path

import numpy as np
import plyfile
import pygltflib
import pytest
import trimesh
from khronos import assert_valid
from PIL import Image
from pliant.solver import InvalidInput
from pliant.worker.artifacts import build_report, write_artifacts
from pliant.worker.artifacts.colours import linear
from pliant.worker.artifacts.geometry import upright
from pliant.worker.formats import Texture, load_inputs, save_inputs
from results import make_result, make_texture

PICTURE = np.zeros((4, 6, 3), dtype=np.uint8)
UV = np.array([[0.0, 0.5], [1.0, 1.0]])


def write(directory: Path, made) -> dict[str, Path]:  # type: ignore[no-untyped-def]
    inputs, solution, options = made
    written = write_artifacts(inputs, solution, options, build_report(inputs, solution, options, metrics={}), directory)
    return {artifact.name: directory / artifact.name for artifact in written}


def expected_colours(texture: Texture) -> np.ndarray:
    """The formula of `make_texture`, interpolated between texel centres at each point; sRGB in [0, 1]."""
    red = (texture.uv[:, 0] * texture.width - 0.5) / (texture.width - 1)
    green = (texture.uv[:, 1] * texture.height - 0.5) / (texture.height - 1)
    return np.column_stack([red, green, np.full(len(red), 128 / 255)])


@pytest.mark.node
@pytest.mark.parametrize(
    ("frames", "quantized", "normals"), [(7, False, "animated"), (7, True, "none"), (230, False, "static")]
)
def test_glb_embeds_the_picture(tmp_path: Path, frames: int, quantized: bool, normals: str) -> None:
    made = make_result(frames, texture=True, outputs="glb", glb_quantized=quantized, normals=normals)
    texture = made[0].texture
    path = write(tmp_path, made)["shapes.glb"]
    assert_valid(path)
    gltf = pygltflib.GLTF2.load_binary(path)
    view = gltf.bufferViews[gltf.images[gltf.textures[0].source].bufferView]
    assert gltf.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength] == texture.jpeg
    material = gltf.materials[gltf.meshes[0].primitives[0].material]
    assert material.doubleSided
    assert material.pbrMetallicRoughness.roughnessFactor == 1
    assert material.pbrMetallicRoughness.baseColorTexture.index == 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        read = trimesh.load(path, process=False).geometry["shape"]
    assert read.visual.material.baseColorTexture.size == (128, 96)
    # trimesh flips v to point up.
    np.testing.assert_allclose(read.visual.uv, np.column_stack([texture.uv[:, 0], 1 - texture.uv[:, 1]]), atol=1e-6)


def test_a_point_cloud_takes_its_colours_from_the_picture(tmp_path: Path) -> None:
    made = make_result(mesh="none", texture=True, outputs="glb")
    gltf = pygltflib.GLTF2.load_binary(write(tmp_path, made)["shapes.glb"])
    assert gltf.images == []
    attributes = gltf.meshes[0].primitives[0].attributes
    assert attributes.TEXCOORD_0 is None
    accessor = gltf.accessors[attributes.COLOR_0]
    start = gltf.bufferViews[accessor.bufferView].byteOffset
    colours = np.frombuffer(gltf.binary_blob(), "<u2", 4 * accessor.count, start).reshape(-1, 4) / 65535
    np.testing.assert_allclose(colours[:, :3], linear(expected_colours(made[0].texture)), atol=0.02)


def test_error_colours_replace_the_texture(tmp_path: Path) -> None:
    files = write(tmp_path, make_result(texture=True, outputs="glb,obj", colours="error"))
    gltf = pygltflib.GLTF2.load_binary(files["shapes.glb"])
    assert gltf.images == []
    assert gltf.meshes[0].primitives[0].attributes.COLOR_0 is not None
    with zipfile.ZipFile(files["shapes_obj.zip"]) as archive:
        assert all(name.endswith(".obj") for name in archive.namelist())


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # trimesh looks for seams and warns that there are none
@pytest.mark.parametrize("normals", ["static", "animated"])
def test_obj_comes_with_material_and_picture(tmp_path: Path, normals: str) -> None:
    made = make_result(texture=True, outputs="obj", normals=normals, axes="tracks")
    texture = made[0].texture
    with zipfile.ZipFile(write(tmp_path, made)["shapes_obj.zip"]) as archive:
        archive.extractall(tmp_path / "out")
        assert archive.namelist()[:3] == ["shapes.mtl", "texture.jpg", "frame_00000.obj"]
    assert (tmp_path / "out" / "texture.jpg").read_bytes() == texture.jpeg
    read = trimesh.load(tmp_path / "out" / "frame_00004.obj", process=False)
    # trimesh reorders the vertices; no two points of the sheet coincide.
    distances = np.linalg.norm(read.vertices[None] - made[1].shapes[4][:, None], axis=2)
    order = distances.argmin(axis=1)
    assert sorted(order) == list(range(30))
    assert distances.min(axis=1).max() < 1e-5
    np.testing.assert_allclose(
        read.visual.uv[order], np.column_stack([texture.uv[:, 0], 1 - texture.uv[:, 1]]), atol=1e-6
    )
    assert read.visual.material.image.size == (128, 96)


def test_ply_has_the_colours_of_the_picture(tmp_path: Path) -> None:
    made = make_result(texture=True, outputs="ply")
    with zipfile.ZipFile(write(tmp_path, made)["shapes_ply.zip"]) as archive:
        contents = [archive.read(name) for name in archive.namelist()]
    assert len(contents) == 7
    for content in contents:
        vertex = plyfile.PlyData.read(io.BytesIO(content))["vertex"]
        colours = np.column_stack([vertex[name] for name in ("red", "green", "blue")]) / 255
        np.testing.assert_allclose(colours, expected_colours(made[0].texture), atol=0.02)
    assert b"colour: the film's template frame" in contents[0]


def test_usdz_contains_the_material_and_the_picture(tmp_path: Path) -> None:
    from pxr import Usd, UsdGeom, UsdShade, UsdValidation

    made = make_result(texture=True, outputs="usd", normals="animated")
    texture = made[0].texture
    files = write(tmp_path, made)
    assert "shapes.usdc" not in files
    assert {path.name for path in tmp_path.iterdir()} == set(files)
    with zipfile.ZipFile(files["shapes.usdz"]) as archive:
        assert archive.namelist() == ["shapes.usdc", "texture.jpg"]
        assert archive.read("texture.jpg") == texture.jpeg
    stage = Usd.Stage.Open(str(files["shapes.usdz"]))
    shape = stage.GetDefaultPrim()
    np.testing.assert_array_equal(
        shape.GetAttribute("points").Get(4), upright(made[1].shapes[4], "down").astype(np.float32)
    )
    places = UsdGeom.PrimvarsAPI(shape).GetPrimvar("st").Get()
    np.testing.assert_allclose(places, np.column_stack([texture.uv[:, 0], 1 - texture.uv[:, 1]]), atol=1e-6)
    material, _ = UsdShade.MaterialBindingAPI(shape).ComputeBoundMaterial()
    surface, _, _ = material.ComputeSurfaceSource()
    source = surface.GetInput("diffuseColor").GetConnectedSources()[0][0].source
    picture = UsdShade.Shader(source.GetPrim()).GetInput("file").Get()
    assert picture.path == "./texture.jpg"
    assert picture.resolvedPath.endswith("shapes.usdz[texture.jpg]")
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    found = UsdValidation.ValidationContext(validators).Validate(stage)
    assert [error.GetMessage() for error in found] == []


def test_usd_points_take_their_colours_from_the_picture(tmp_path: Path) -> None:
    from pxr import Usd, UsdGeom

    made = make_result(mesh="none", texture=True, outputs="usd")
    stage = Usd.Stage.Open(str(write(tmp_path, made)["shapes.usdc"]))
    colours = UsdGeom.PrimvarsAPI(stage.GetDefaultPrim()).GetPrimvar("displayColor")
    assert colours.GetInterpolation() == UsdGeom.Tokens.vertex
    np.testing.assert_allclose(colours.Get(), linear(expected_colours(made[0].texture)), atol=0.02)


def test_a_failed_usdz_write_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from pxr import UsdUtils

    monkeypatch.setattr(UsdUtils, "CreateNewUsdzPackage", lambda *_: False)
    with pytest.raises(OSError, match="could not write the package"):
        write(tmp_path, make_result(texture=True, outputs="usd"))
    assert {path.name for path in tmp_path.iterdir()} == {"shapes.npz"}


def test_equal_textured_results_give_identical_files(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    first, second = (
        write(tmp_path / name, make_result(texture=True, outputs="glb,obj,usd,mdd")) for name in ("a", "b")
    )
    for name in set(first) - {"report.json"}:
        assert first[name].read_bytes() == second[name].read_bytes(), name


@pytest.mark.parametrize("y_axis", ["down", "up"])
def test_mdd_holds_every_frame(tmp_path: Path, y_axis: str) -> None:
    made = make_result(y_axis=y_axis, outputs="mdd", fps=12.5)
    content = write(tmp_path, made)["shapes.mdd"].read_bytes()
    frames, points = struct.unpack_from(">2i", content)
    assert (frames, points) == (7, 30)
    times = struct.unpack_from(f">{frames}f", content, 8)
    np.testing.assert_allclose(times, np.arange(7) / 12.5, rtol=1e-6)
    coordinates = struct.unpack_from(f">{3 * frames * points}f", content, 8 + 4 * frames)
    assert len(content) == 8 + 4 * frames + 12 * frames * points
    expected = upright(made[1].shapes, y_axis).astype(np.float32)
    np.testing.assert_array_equal(np.reshape(coordinates, (7, 30, 3)).astype(np.float32), expected)


def test_the_texture_is_stored_with_the_inputs(tmp_path: Path) -> None:
    inputs = make_result(texture=True)[0]
    save_inputs(inputs, tmp_path / "inputs.npz")
    read = load_inputs(tmp_path / "inputs.npz").texture
    assert inputs.texture is not None
    assert read is not None
    assert (read.jpeg, read.width, read.height) == (inputs.texture.jpeg, 128, 96)
    np.testing.assert_array_equal(read.uv, inputs.texture.uv)
    assert not read.uv.flags.writeable
    save_inputs(make_result()[0], tmp_path / "without.npz")
    assert load_inputs(tmp_path / "without.npz").texture is None


def test_colours_are_interpolated_between_texels() -> None:
    texture = make_texture(5, 6)
    np.testing.assert_allclose(texture.colours(), expected_colours(texture), atol=0.02)
    some = texture.at_points(np.array([3, 7]))
    np.testing.assert_array_equal(some.colours(), texture.colours()[[3, 7]])
    assert Image.open(io.BytesIO(texture.jpeg)).size == (128, 96)
    corners = Texture.from_tracked(PICTURE + np.uint8(255), [[0, 0], [1, 1]])
    np.testing.assert_allclose(corners.colours(), 1, atol=0.01)


@pytest.mark.parametrize(
    ("picture", "uv", "code", "field"),
    [
        (PICTURE.astype(float), UV, "wrong_shape", "texture"),
        (PICTURE[..., 0], UV, "wrong_shape", "texture"),
        (PICTURE[:0], UV, "wrong_shape", "texture"),
        (PICTURE, UV[:, :1], "wrong_shape", "texture.uv"),
        (PICTURE, UV * 1.01, "out_of_range", "texture.uv"),
        (PICTURE, UV * np.nan, "out_of_range", "texture.uv"),
    ],
)
def test_invalid_textures_are_rejected(picture: np.ndarray, uv: np.ndarray, code: str, field: str) -> None:
    with pytest.raises(InvalidInput) as refused:
        Texture.from_tracked(picture, uv)
    assert (refused.value.code, refused.value.field) == (code, field)
