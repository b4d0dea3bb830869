"""Where results go: no file gets another format than its name says, and nothing is computed that cannot be written."""

from __future__ import annotations

import gzip
from pathlib import Path

import pytest

from potr_cl import UsageError, cli, encode
from potr_cl.formats import load_scene
from potr_cl.formats.scenes import ply
from tests.cli.calls import cameras_json, refused
from tests.reference.scenes import random_scene


@pytest.fixture(scope="module")
def files(tmp_path_factory, encoded):
    """A scene, what encode makes of it, cameras, and a folder."""
    folder = tmp_path_factory.mktemp("files")
    ply.save(folder / "a.ply", random_scene(100, 1))
    (folder / "a.potr").write_bytes(encoded)
    cameras_json(folder / "cameras.json")
    (folder / "sub").mkdir()
    return folder


#: What places views, where no cameras are given.
PLACED = ("--turntable 3", "--virtual-views 3", "--up z", "--size 3")
#: Values of options that are out of range, and what is said of them.
WRONG = {
    "encode": [
        *(("-q 1.5", "quality"), ("-q nan", "quality"), ("--sf-sh 0", "sf_sh"), ("--gamma -1", "gamma")),
        *(("--zstd-level 40", "level 40"), ("--threads -2", "--threads")),
        *(("--compact-at 2", "--compact-at is 2"), ("--refit-at 2", "--refit-at is 2")),
        *((f"--max-size={size}", "size") for size in ("8bananas", "", "-5", "1e", "1.2.3M")),
        *(
            ("--max-size=0.1", "0.1 bytes"),
            ("--min-psnr -3", "-3 dB"),
            ("--cameras cameras.json --virtual-views 8", "leave it out, or --cameras"),
        ),
    ],
    "prune": [
        *(("--keep 0", "--keep"), ("--keep 1.5", "--keep"), ("--count 0", "at least 1")),
        *(("--iterations 0", "iterations"), ("--delta-mse-max -1", "delta_mse_max")),
        *(("--tolerance nan", "tolerance"), ("--memory -2", "memory"), ("--background octarine", "octarine")),
    ],
    "compact": [
        *(("--lambda -1", "lam"), ("--alpha 0", "alpha"), ("--alpha 1.5", "alpha"), ("--sf-sh 0", "sf_sh")),
        *(("-q 2", "quality"), ("--memory -1", "memory"), ("--background octarine", "octarine")),
    ],
    "refit": [("--steps=-1", "steps"), ("--prior -1", "prior"), ("--lambda nan", "lam"), ("--drop inf", "drop")],
    "fit": [("--steps=-1", "-1 steps"), ("--steps 10000000", "steps of the fit"), ("--views-between 101", "0 to 100")],
    "render": [
        *(("--up sideways", "--up=x|y|z|-x|-y|-z"), ("--up 0,0,0", "'0,0,0' is not a direction")),
        ("--up nan,0,1", "is not a direction"),
        ("--background beige-ish", "unknown colour 'beige-ish'"),
        *((f"--cameras cameras.json {one}", "without cameras") for one in PLACED),
    ],
    "compare": [(f"--cameras cameras.json {one}", "without cameras") for one in PLACED],
}


@pytest.mark.parametrize(
    ("call", "said"),
    [
        ("encode a.ply -o b.gltf", "encode to 'b.potr', then 'potr-cl decode b.potr -o b.gltf'"),
        ("encode a.ply -o b.splat", "ends in '.splat', which cannot be written: give it one of .potr, .spz"),
        ("encode a.ply -o b.spz --entropy zstd", "--entropy does not apply to .spz files"),
        ("encode a.ply -o b.ply --sf-dc 9", "--sf-dc does not apply to .ply files"),
        ("encode a.ply -o b.potr --spz-version 3", "potr_cl has no version to choose"),
        ("encode a.ply -o sub --to sog4", "'.sog4' is no suffix of what encode writes"),
        ("encode a.ply -o b.png", "ends in '.png', which cannot be written: give it one of .potr, .spz"),
        ("encode a.ply -o b", "'b' has no suffix to tell the format: give it one of .potr, .spz"),
        ("encode a.ply -o b.potr --report b.png", "a name that ends in .html"),
        ("decode a.potr -o b.splat", "give it one of .ply, .compressed.ply"),
        ("decode a.potr -o b.potr", "command encode"),
        ("decode a.potr -o b.png", "ends in '.png', which cannot be written: give it one of .ply"),
        ("decode a.potr -o b", "'b' has no suffix to tell the format: give it one of .ply"),
        ("decode a.potr -o b.ply --to spz", "already gives the format"),
        ("decode a.potr -o sub --to splat", "give it one of .ply"),
        ("decode a.potr -o sub --to .xyz", "'.xyz' is no suffix of a scene"),
        ("convert a.ply b.xyz", "ends in '.xyz', which cannot be written: give it one of .ply"),
        ("prune a.ply -o b.splat", "give it one of .ply"),
        ("prune a.ply -o b.potr", "command encode"),
        ("prune a.ply -o b.ply --order b.txt", "--order writes an array of NumPy"),
        ("compact a.ply -o b.png", "give it one of .ply"),
        ("refit a.ply --reference a.ply -o b.png", "give it one of .ply"),
        ("compare a.ply a.potr --cameras none -o b.jpg", "a name that ends in .png"),
        ("render a.ply --cameras none -o a.potr", "a file of this name"),
        ("render a.ply --cameras none -o b.png", "a folder of pictures is written"),
        ("convert a.ply b.ply --spz-version 3", "has no versions to choose from"),
        ("encode a.ply -o no/b.potr", "no' does not exist"),
        ("encode a.ply -o ~/b.potr", "'~' is not expanded here: write the home folder out"),
        ("decode a.potr -o a.ply/b.ply", "a.ply' is not a folder"),
        ("render a.ply -o -", "'-' is standard output, which this argument does not take: give it a name"),
        ("render - -o pictures", "'-' is standard input, which this argument does not take: give it a name"),
        ("compare a.ply -", "'-' is standard input"),
        ("compare a.ply a.ply -o -", "'-' is standard output"),
        ("view -", "'-' is standard input"),
        ("encode a.ply -o b.potr --cameras -", "'-' is standard input"),
        ("encode a.ply -o b.potr --report -", "'-' is standard output"),
        ("prune a.ply -o b.ply --order -", "'-' is standard output"),
        ("encode a.ply -o b.potr --report no/b.html", "no' does not exist"),
        ("encode a.ply -o b.potr --report sub", "is a directory"),
        ("decode a.potr -o no/b.ply", "no' does not exist"),
        ("info .", "is a folder: give the scene in it"),
        ("prune a.ply -o sub", "is a directory"),
        ("compact a.ply -o sub", "is a directory"),
        ("refit a.ply --reference a.ply -o sub", "is a directory"),
        ("compare a.ply a.potr --cameras none -o sub", "is a directory"),
        *((f"encode a.ply -o b.potr {wrong}", said) for wrong, said in [*WRONG["encode"], *WRONG["prune"]]),
        *((f"prune a.ply -o b.ply {wrong}", said) for wrong, said in WRONG["prune"]),
        *((f"compact a.ply -o b.ply {wrong}", said) for wrong, said in WRONG["compact"]),
        *((f"refit a.ply --reference a.ply -o b.ply {wrong}", said) for wrong, said in WRONG["refit"]),
        *((f"fit a.ply --reference a.ply -o b.ply {wrong}", said) for wrong, said in WRONG["fit"]),
        *((f"render a.ply -o new {wrong}", said) for wrong, said in WRONG["render"]),
        *((f"compare a.ply a.ply {wrong}", said) for wrong, said in WRONG["compare"]),
        ("encode a.ply -o sub --ladder 0.5 --cameras cameras.json --virtual-views 8", "leave it out, or --cameras"),
    ],
)
def test_refused_in_one_line_before_any_work(files, capsys, monkeypatch, call, said):
    monkeypatch.chdir(files)
    for reader in ("potr_cl.formats.load_scene", "potr_cl.cli.files.decode", "potr_cl.cli.options.load_cameras"):
        monkeypatch.setattr(reader, lambda *_, **__: pytest.fail("something was read"))
    refused(capsys, call, said)


@pytest.mark.parametrize(
    ("command", "suffix"),
    [
        *(("convert a.ply", suffix) for suffix in (".spz", ".PLY", ".compressed.ply")),
        ("decode a.potr -o", ".spz"),
        ("prune a.ply --iterations 2 --cameras cameras.json -o", ".PLY"),
        ("compact a.ply --cameras cameras.json -o", ".compressed.ply"),
        ("refit a.ply --reference a.ply --steps 1 --cameras cameras.json -o", ".spz"),
    ],
)
def test_a_scene_is_written_as_its_name_says(files, tmp_path, monkeypatch, command, suffix):
    monkeypatch.chdir(files)
    out = tmp_path / f"out{suffix}"
    assert cli.main([*command.split(), str(out)]) == 0
    content = out.read_bytes()
    assert content.startswith(b"\x1f\x8b" if suffix == ".spz" else b"ply")
    assert (b"packed_position" in content[:4000]) == ("compressed" in suffix)
    assert 0 < len(load_scene(out)) <= 200


@pytest.mark.parametrize(("options", "version"), [([], 2), (["2"], 2), (["3"], 3), (["4"], 4)])
def test_versions_of_spz(files, tmp_path, options, version):
    out = tmp_path / "a.spz"
    assert cli.main(["convert", str(files / "a.ply"), str(out), *(["--spz-version", *options] if options else [])]) == 0
    content = out.read_bytes()
    content = content if content.startswith(b"NGSP") else gzip.decompress(content)
    assert content[:5] == b"NGSP%c" % version
    assert len(load_scene(out)) == 100


def test_encode_from_python_writes_no_other_name(files, monkeypatch):
    monkeypatch.chdir(files)
    with pytest.raises(UsageError, match=r"give it one of \.potr"):
        encode("a.ply", output="b.splat", prune=False, compact=False, refit="off")
    assert not Path("b.splat").exists()
