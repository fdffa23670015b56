"""Write an animated binary glTF 2.0 (.glb): one mesh with morph targets, a camera, and one animation of both.

The file is streamed: the JSON comes first, so sizes, offsets, minima and maxima are computed before any array is written.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator
from functools import partial
from importlib.metadata import version
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray
from pliant.worker.artifacts.animation import Animation
from pliant.worker.artifacts.geometry import Floats, Ints, Singles, vertex_normals
from pliant.worker.artifacts.names import DEFAULT
from pliant.worker.artifacts.normals import fit_normals
from pliant.worker.artifacts.view import View
from pliant.worker.formats import Texture

COMPONENTS = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123, "uint32": 5125, "float32": 5126}
TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
VERTICES, INDICES = 34962, 34963
POINTS, TRIANGLES = 0, 4
LINEAR, MIPMAPS, CLAMPED = 9729, 9987, 33071
CLAY = [0.74, 0.62, 0.55, 1.0]


Array = NDArray[np.generic]
Make = Callable[[], Array]


class Buffer:
    """Arrays in the order of writing, and the glTF objects that refer to them.

    An array given as a function is generated twice, once for its bounds and once for writing, and not kept in between.
    """

    def __init__(self) -> None:
        self.parts: list[tuple[Make, int]] = []
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []
        self.bytes = 0

    def add(
        self, given: Array | Make, *, target: int | None = None, bounds: bool = False, normalised: bool = False
    ) -> int:
        """Append an array `(N,)` or `(N, width)` as a buffer view; return the index of its accessor.

        Rows of vertex data start at multiples of four bytes, so rows of other lengths are padded with zeros.
        """
        make: Make = given if callable(given) else lambda: given
        array = make()
        rows = array.reshape(len(array), -1)
        count, width = rows.shape
        size = rows.dtype.itemsize
        stride = width * size
        view: dict[str, Any] = {"buffer": 0, "byteOffset": self.bytes}
        if target == VERTICES and stride % 4:
            stride = -(-stride // 4) * 4
            view["byteStride"] = stride
        if target is not None:
            view["target"] = target
        view["byteLength"] = count * stride
        accessor: dict[str, Any] = {
            "bufferView": len(self.views), "componentType": COMPONENTS[rows.dtype.name], "count": count, "type": TYPES[width],
        }  # fmt: skip
        if normalised:
            accessor["normalized"] = True
        if bounds:
            accessor["min"], accessor["max"] = rows.min(axis=0).tolist(), rows.max(axis=0).tolist()
        self.views.append(view)
        self.accessors.append(accessor)
        self.parts.append((make, stride))
        self.bytes += -(-count * stride // 4) * 4
        return len(self.accessors) - 1

    def attach(self, content: bytes) -> int:
        """Append a file as a buffer view; return the view's index."""
        self.views.append({"buffer": 0, "byteOffset": self.bytes, "byteLength": len(content)})
        self.parts.append((lambda: np.frombuffer(content, dtype=np.uint8), 1))
        self.bytes += -(-len(content) // 4) * 4
        return len(self.views) - 1

    def chunks(self) -> Iterator[bytes]:
        """Yield the bytes of one array after the other, little-endian, each padded to a multiple of four."""
        for make, stride in self.parts:
            array = make()
            rows = array.reshape(len(array), -1).astype(array.dtype.newbyteorder("<"), copy=False)
            padded = np.zeros((len(rows), stride // rows.dtype.itemsize), dtype=rows.dtype)
            padded[:, : rows.shape[1]] = rows
            yield padded.tobytes() + b"\0" * (-padded.nbytes % 4)


def write_glb(
    file: IO[bytes], animation: Animation, triangles: Ints, *, times: Floats, node: dict[str, Any], name: str = DEFAULT,
    normals: str = "static", quantized: bool = False, colours: NDArray[np.uint16] | None = None, texture: Texture | None = None,
    view: View | None = None, on_progress: Callable[[float], None] | None = None,
) -> None:  # fmt: skip
    """Write the animation, y up and right-handed, from the file's current position.

    Frame f is at `times[f]` seconds, interpolated linearly. Without triangles `(T, 3)` a point cloud is written. `node` holds
    the properties of the node besides the mesh, e.g. `scale`. `normals` are `static` (those of the base shape), `animated` (displaced with
    the targets) or `none`. `quantized` writes 16-bit positions and 8-bit normals by KHR_mesh_quantization. `colours (P, 4)` are RGBA,
    linear light, 65535 for 1. The camera of `view` follows the mesh. `on_progress` gets the share of arrays written.
    """
    buffer = Buffer()
    positions, target, placed = _rounded(animation, node, quantized=quantized)
    still, moving = _normals(animation, triangles, normals if len(triangles) else "none")
    attributes = _attributes(buffer, positions, still, colours, texture, quantized=quantized)
    primitive = {"attributes": attributes, "material": 0, "mode": TRIANGLES if len(triangles) else POINTS}
    if len(triangles):
        short = len(animation.base) < 0xFFFF
        indices = triangles.reshape(-1).astype(np.uint16 if short else np.uint32)
        primitive["indices"] = buffer.add(indices, target=INDICES)
    primitive["targets"] = _targets(buffer, animation, target, quantized=quantized, normals=moving)
    mesh = {
        "name": name,
        "primitives": [primitive],
        "weights": animation.weights[0].tolist(),
        "extras": {"targetNames": animation.names, "pliant": animation.extras},
    }
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": f"Pliant {version('pliant')}"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": name, "mesh": 0, **placed}],
        "meshes": [mesh],
        "materials": [_material(coloured=colours is not None, textured=texture is not None)],
        "animations": [_motion(buffer, animation, times)],
        "bufferViews": buffer.views,
        "accessors": buffer.accessors,
    }
    if view is not None:
        _add_camera(document, buffer, view, name="camera" if name != "camera" else "film camera")
    if texture is not None:
        _add_picture(document, buffer, texture)
    document["buffers"] = [{"byteLength": buffer.bytes}]
    if quantized:
        document["extensionsUsed"] = document["extensionsRequired"] = ["KHR_mesh_quantization"]
    _write(file, document, buffer, on_progress)


def _attributes(
    buffer: Buffer,
    positions: Array,
    normals: Singles | None,
    colours: NDArray[np.uint16] | None,
    texture: Texture | None,
    *,
    quantized: bool,
) -> dict[str, int]:
    """Add the vertex attributes of the base shape."""
    attributes = {"POSITION": buffer.add(positions, target=VERTICES, bounds=True, normalised=quantized)}
    if normals is not None:
        rounded = _in_bytes(normals) if quantized else normals
        attributes["NORMAL"] = buffer.add(rounded, target=VERTICES, normalised=quantized)
    if colours is not None:
        attributes["COLOR_0"] = buffer.add(colours, target=VERTICES, normalised=True)
    if texture is not None:
        attributes["TEXCOORD_0"] = buffer.add(texture.uv, target=VERTICES)
    return attributes


def _motion(buffer: Buffer, animation: Animation, times: Floats) -> dict[str, Any]:
    """Add the times and the weights of the targets; return the glTF animation that plays them."""
    sampler = {
        "input": buffer.add(times.astype(np.float32), bounds=True),
        "output": buffer.add(animation.weights.reshape(-1)),
        "interpolation": "LINEAR",
    }
    channel = {"sampler": 0, "target": {"node": 0, "path": "weights"}}
    return {"name": "motion", "samplers": [sampler], "channels": [channel]}


def _add_picture(document: dict[str, Any], buffer: Buffer, texture: Texture) -> None:
    document["images"] = [{"name": "film", "mimeType": "image/jpeg", "bufferView": buffer.attach(texture.jpeg)}]
    document["samplers"] = [{"magFilter": LINEAR, "minFilter": MIPMAPS, "wrapS": CLAMPED, "wrapT": CLAMPED}]
    document["textures"] = [{"source": 0, "sampler": 0}]


def _add_camera(document: dict[str, Any], buffer: Buffer, view: View, *, name: str) -> None:
    """Add camera, node and the two channels of its motion, with the times of the weights."""
    document["cameras"] = [view.lens]
    document["nodes"].append(
        {"name": name, "camera": 0, "rotation": view.rotations[0].tolist(), "translation": view.translations[0].tolist()}
    )  # fmt: skip
    document["scenes"][0]["nodes"].append(1)
    motion = document["animations"][0]
    for path, values in (("rotation", view.rotations), ("translation", view.translations)):
        motion["channels"].append({"sampler": len(motion["samplers"]), "target": {"node": 1, "path": path}})
        motion["samplers"].append(
            {"input": motion["samplers"][0]["input"], "output": buffer.add(values), "interpolation": "LINEAR"}
        )


def _normals(
    animation: Animation, triangles: Ints, normals: str
) -> tuple[Singles | None, Callable[[int], Singles | None] | None]:
    """Return the base normals, and a function that gives their displacement for a target (None: zero); None for whatever is omitted."""
    if normals == "none":
        return None, None
    if normals == "static":
        return vertex_normals(animation.base, triangles), None
    if animation.extras["encoding"] == "modes":
        fitted = fit_normals(animation, triangles)
        animation.extras.update(normal_targets=len(fitted.targets), normal_rms_error=fitted.rms)
        return fitted.base, lambda index: fitted.targets[index] if index < len(fitted.targets) else None
    base = vertex_normals(animation.base, triangles)
    return base, lambda index: vertex_normals(animation.base + animation.target(index), triangles) - base


def _targets(
    buffer: Buffer, animation: Animation, target: Callable[[int], Array], *, quantized: bool,
    normals: Callable[[int], Singles | None] | None,
) -> list[dict[str, int]]:  # fmt: skip
    found, zeros = [], None
    for index in range(len(animation.names)):
        entry = {"POSITION": buffer.add(partial(target, index), target=VERTICES, bounds=True, normalised=quantized)}
        if normals is not None:
            if normals(index) is None:
                # Without NORMAL here, three.js would use the base normals as the displacement.
                if zeros is None:
                    # Stored, because Assimp and VTK refuse accessors without data, which glTF allows.
                    still = np.zeros((len(animation.base), 3), np.int8 if quantized else np.float32)
                    zeros = buffer.add(still, target=VERTICES, normalised=quantized)
                entry["NORMAL"] = zeros
            else:
                entry["NORMAL"] = buffer.add(
                    partial(_displacement, normals, index, quantized), target=VERTICES, normalised=quantized
                )
        found.append(entry)
    return found


def _displacement(normals: Callable[[int], Singles | None], index: int, quantized: bool) -> Array:
    moved = normals(index)
    assert moved is not None
    return _in_bytes(moved) if quantized else moved


def _in_bytes(normals: Singles) -> NDArray[np.int8]:
    """Round normals or their displacements to bytes, exact to half a degree; displacements beyond 1 are clipped."""
    return np.rint(np.clip(normals, -1, 1) * 127).astype(np.int8)


def _rounded(
    animation: Animation, node: dict[str, Any], *, quantized: bool
) -> tuple[Array, Callable[[int], Array], dict[str, Any]]:
    """Return positions, displacements and node; if `quantized`, 16-bit fractions of one size, which the node's scale restores.

    The bound of their rounding error is added to the animation's `max_error`.
    """
    if not quantized:
        return animation.base, animation.target, node
    low, high = animation.base.min(axis=0), animation.base.max(axis=0)
    centre = ((low + high) / 2).astype(np.float64)
    moved = max(float(np.abs(animation.target(index)).max()) for index in range(len(animation.names)))
    size = max(float(np.abs(animation.base - centre).max()), moved, 1e-30)

    def target(index: int) -> Array:
        return np.asarray(np.rint(animation.target(index) / size * 32767).astype(np.int16))

    positions = np.rint((animation.base - centre) / size * 32767).astype(np.int16)
    half_step = size / 32767 / 2  # of the base and of each target
    animation.extras["max_error"] += half_step * (1 + float(np.abs(animation.weights).sum(axis=1).max()))
    scale = float(node.get("scale", [1.0])[0])
    placed = {**node, "scale": [scale * size] * 3, "translation": (scale * centre).tolist()}
    return positions, target, placed


def _material(*, coloured: bool, textured: bool) -> dict[str, Any]:
    if textured:
        # The picture of the film already contains its lighting, so the surface adds no highlights.
        return {
            "name": "film", "doubleSided": True,
            "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "metallicFactor": 0.0, "roughnessFactor": 1.0},
        }  # fmt: skip
    base = [1.0, 1.0, 1.0, 1.0] if coloured else CLAY
    return {
        "name": "clay", "doubleSided": True,
        "pbrMetallicRoughness": {"baseColorFactor": base, "metallicFactor": 0.0, "roughnessFactor": 0.75},
    }  # fmt: skip


def _write(
    file: IO[bytes], document: dict[str, Any], buffer: Buffer, on_progress: Callable[[float], None] | None
) -> None:
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    file.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + buffer.bytes))
    file.write(struct.pack("<I4s", len(text), b"JSON") + text)
    file.write(struct.pack("<I4s", buffer.bytes, b"BIN\0"))
    for index, chunk in enumerate(buffer.chunks()):
        file.write(chunk)
        if on_progress is not None:
            on_progress((index + 1) / len(buffer.parts))
