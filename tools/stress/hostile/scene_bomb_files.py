"""Small files of scenes in several files, glTF, .splat, .ksplat and gzip that claim much: BOMBS, by format and name."""

from __future__ import annotations

import gzip
import json
from collections.abc import Callable
from random import Random

from tools.stress.hostile import gltf_files, sog_files, sog_folder_files, splat_files

#: Files that belong together, by their names; the first is what is read.
Files = dict[str, bytes]

_LONG = 1 << 26


def _sog_names(name: str) -> Files:
    files = dict(sog_folder_files.originals()[0])
    meta = json.loads(files["meta.json"])
    meta["sh0"]["files"] = [name]
    return files | {"meta.json": json.dumps(meta).encode()}


def _levels(folders: int) -> Files:
    meta = json.loads(sog_folder_files.originals()[0]["meta.json"])
    small = json.dumps(meta | {"count": 65_536, "scales": {}, "sh0": {}}).encode()
    leaves = [{"lods": {"0": {"file": k, "offset": 0, "count": 65_536}}} for k in range(folders)]
    names = [f"{k}.json" for k in range(folders)]
    tree = {"lodLevels": 1, "filenames": names, "tree": {"children": leaves}}
    return {"lod-meta.json": json.dumps(tree).encode()} | dict.fromkeys(names, small)


def _leaves(ranges: list[tuple[int, int]]) -> Files:
    leaves = [{"lods": {"0": {"file": 0, "offset": first, "count": count}}} for first, count in ranges]
    meta = {"lodLevels": 1, "filenames": ["0/meta.json"], "tree": {"children": leaves}}
    return sog_folder_files.streamed(meta, {"0": (5, 0)})


def _nodes(number: int, splats: int = 100) -> Files:
    description, content = gltf_files.asset(splats, 0, False, Random(0))
    description |= {"nodes": [{"mesh": 0}] * number, "scenes": [{"nodes": list(range(number))}]}
    return gltf_files.described_bomb(description, content)


def _accessors(count: int, view: int | None = 0, stride: int | None = None) -> Files:
    description, content = gltf_files.asset(5, 0, False, Random(0))
    for accessor in description["accessors"]:
        accessor["count"] = count
        if view is None:
            del accessor["bufferView"]
    for each in description["bufferViews"]:
        each["byteStride"] = each["byteStride"] if stride is None else stride
    return gltf_files.described_bomb(description, content)


def _empty_nodes(number: int) -> Files:
    description, content = gltf_files.asset(5, 0, False, Random(0))
    description |= {"nodes": [{}] * number, "scenes": [{"nodes": list(range(number))}]}
    return {"a.gltf": gltf_files.gltf(description, content, None)}


def _chain(number: int) -> Files:
    description, content = gltf_files.asset(5, 0, False, Random(0))
    nodes = [{"children": [k + 1], "scale": [2, 2, 2]} for k in range(number)]
    description |= {"nodes": [*nodes, {"mesh": 0}]}
    return {"a.gltf": gltf_files.gltf(description, content, None)}


def _base64(text: bytes) -> Files:
    description, content = gltf_files.asset(5, 0, False, Random(0))
    return {"a.gltf": gltf_files.gltf(description, content, "data:;base64," + text.decode())}


def _ksplat(at: int, size: int, value: int) -> Files:
    data = bytearray(splat_files.ksplat_originals()[8])
    data[at : at + size] = value.to_bytes(size, "little")
    return {"a.ksplat": bytes(data)}


def _gzipped_zeros() -> Files:
    names = ["x", "y", "z", *(f"f_dc_{i}" for i in range(3)), "opacity", *(f"scale_{i}" for i in range(3))]
    names += [f"rot_{i}" for i in range(4)]
    splats = (1 << 24) // (4 * len(names))
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {splats}"]
    header += [*(f"property float {name}" for name in names), "end_header", ""]
    return {"a.ply.gz": gzip.compress("\n".join(header).encode() + bytes(4 * len(names) * splats), 9, mtime=0)}


BOMBS: dict[str, dict[str, Callable[[], Files]]] = {
    "sog-folder": {
        "pictures of 4,000², all splats claimed": lambda: sog_files.equal_splats(4000, 16_000_000),
        "pictures of 4,000², one splat claimed": lambda: sog_files.equal_splats(4000, 1),
        "64 MB of brackets as description": lambda: {"meta.json": b"[" * _LONG},
        "a device as a picture": lambda: _sog_names("/dev/zero"),
    },
    "sog-levels": {
        "1,000 folders of 65,536 splats claimed": lambda: _levels(1000),
        "one splat in 100,000 leaves": lambda: _leaves([(0, 1)] * 100_000),
        "2⁶⁰ splats claimed in a leaf": lambda: _leaves([(0, 1 << 60)]),
        "100,000 nested nodes": lambda: {"lod-meta.json": b'{"tree":' + b'{"children":[' * 100_000},
    },
    "glb": {
        "65,536 nodes with one mesh": lambda: _nodes(65_536),
        "65,536 nodes with one splat": lambda: _nodes(65_536, 1),
        "4,096 nodes with one splat": lambda: _nodes(4096, 1),
        "2³¹ splats claimed": lambda: _accessors(count=(1 << 31) - 1),
        "16 million splats claimed in nothing": lambda: _accessors(count=1 << 24, view=None),
        "a stride of nothing": lambda: _accessors(count=1 << 24, stride=0),
        "4 GB claimed in the header": lambda: {"a.glb": b"glTF\2\0\0\0" + b"\xff" * 4 + b"\xf0\xff\xff\xffJSON{}"},
        "100,000 nested objects": lambda: {"a.glb": gltf_files.glb(b'{"asset":' * 100_000, b"")},
    },
    "gltf": {
        "500,000 empty nodes": lambda: _empty_nodes(500_000),
        "a chain of 20,000 nodes": lambda: _chain(20_000),
        "64 MB in base64 that is none": lambda: _base64(b"!" * (_LONG // 4)),
    },
    "splat": {"empty": lambda: {"a.splat": b""}},
    "ksplat": {
        "2³² sections claimed": lambda: _ksplat(4, 4, 0xFFFFFFFF),
        "2³² splats claimed": lambda: _ksplat(4100, 4, 0xFFFFFFFF),
        "2³² buckets of 2³² claimed": lambda: _ksplat(4104, 4, 0xFFFFFFFF),
        "2³² other buckets claimed": lambda: _ksplat(4132, 4, 0xFFFFFFFF),
        "a bucket of 2³² splats": lambda: _ksplat(5120, 4, 0xFFFFFFFF),
    },
    "ply.gz": {
        "64 MB of blanks": lambda: {"a.ply.gz": gzip.compress(b" " * _LONG, 9, mtime=0)},
        "16 MB of splats in zeros": _gzipped_zeros,
        "64 MB in members without content": lambda: {"a.ply.gz": gzip.compress(b"", mtime=0) * 100_000},
    },
}
