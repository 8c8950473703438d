"""The flag of SPZ files, and what a streamed SOG's description names."""

import gzip
import json
import struct

import pytest

from freqgs_plugin.io.ply import SplatFileError
from freqgs_plugin.io.splat_transform import finest_files
from freqgs_plugin.io.spz import mark_antialiased, read_antialiased


def header(version):
    return b"NGSP" + struct.pack("<IIBBBB", version, 800, 3, 12, 0, 0) + b"points"


@pytest.mark.parametrize("version, pack", [(2, gzip.compress), (3, gzip.compress), (4, bytes)])
def test_the_flag_is_set_and_nothing_else(tmp_path, version, pack):
    path = tmp_path / "a.spz"
    path.write_bytes(pack(header(version)))
    assert not read_antialiased(path)
    mark_antialiased(path)
    assert read_antialiased(path)
    content = path.read_bytes() if version == 4 else gzip.decompress(path.read_bytes())
    assert [i for i, (a, b) in enumerate(zip(content, header(version), strict=True)) if a != b] == [14]


@pytest.mark.parametrize(
    "content",
    [b"", b"NGSP", b"ply\nformat", gzip.compress(header(3), mtime=0)[:-9], b"\x1f\x8bnothing"],
    ids=["empty", "short", "ply", "cut", "no gzip"],
)
def test_what_is_no_spz_is_named(tmp_path, content):
    (tmp_path / "a.spz").write_bytes(content)
    with pytest.raises(SplatFileError, match=r"a\.spz is "):
        read_antialiased(tmp_path / "a.spz")
    with pytest.raises(SplatFileError):
        mark_antialiased(tmp_path / "a.spz")
    assert (tmp_path / "a.spz").read_bytes() == content


def leaf(*files):
    return {"lods": {str(lod): {"file": file, "offset": 0, "count": 1} for lod, file in enumerate(files)}}


def streamed(tmp_path, names, tree):
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("{}")
    (tmp_path / "lod-meta.json").write_text(json.dumps({"filenames": names, "tree": tree}))
    return tmp_path / "lod-meta.json"


def test_the_finest_level_of_all_chunks(tmp_path):
    names = ["1_0/meta.json", "0_0/meta.json", "0_1/meta.json"]
    tree = {"children": [leaf(1, 0), {"children": [leaf(2, 0), leaf(1)]}, {"lods": {"1": {"file": 0}}}]}
    assert finest_files(streamed(tmp_path, names, tree)) == [tmp_path / "0_0/meta.json", tmp_path / "0_1/meta.json"]


@pytest.mark.parametrize("tree", [{}, [], leaf(7), {"lods": {"1": {"file": 0}}}, {"lods": 3}, {"children": [3]}])
def test_a_damaged_description_is_named(tmp_path, tree):
    path = streamed(tmp_path, ["0_0/meta.json"], tree)
    with pytest.raises(SplatFileError, match=r"lod-meta\.json .*export it again"):
        finest_files(path)


def test_files_elsewhere_are_not_read(tmp_path):
    (tmp_path / "sog").mkdir()
    (tmp_path / "secret.json").write_text("{}")
    path = streamed(tmp_path / "sog", [], leaf(0))
    path.write_text(json.dumps({"filenames": ["../secret.json"], "tree": leaf(0)}))
    with pytest.raises(SplatFileError, match="names no files of a finest level beside it"):
        finest_files(path)
    path.write_text("{")
    with pytest.raises(SplatFileError, match="damaged"):
        finest_files(path)
