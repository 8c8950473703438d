import os
import struct
from collections import OrderedDict
from dataclasses import replace

import numpy as np
import plyfile
import pytest
import torch

from freqgs_plugin.functional.cost import bytes_per_gaussian
from freqgs_plugin.functional.harmonics import C0, num_coefficients
from freqgs_plugin.io.parameters import RawGaussians
from freqgs_plugin.io.ply import SplatFileError, read_ply, write_ply

FIELDS = ("means", "scales", "quats", "features_dc", "features_rest", "opacities")


def gaussians(n=12, degree=3, seed=0, **more):
    g = torch.Generator().manual_seed(seed)
    return RawGaussians(
        means=torch.randn(n, 3, generator=g),
        scales=torch.randn(n, 3, generator=g) - 4,
        quats=torch.randn(n, 4, generator=g),
        features_dc=torch.randn(n, 3, generator=g),
        features_rest=torch.randn(n, num_coefficients(degree) - 1, 3, generator=g),
        opacities=2 * torch.randn(n, 1, generator=g),
        **more,
    )


def same(a, b):
    for name in (*FIELDS, "level", "decay"):
        x, y = getattr(a, name), getattr(b, name)
        assert (x is None) == (y is None), name
        if x is not None:
            assert x.shape == y.shape, name
            assert x.numpy().tobytes() == y.to(x.dtype).numpy().tobytes(), name


def names(raw, normals=False, dc=("f_dc_0", "f_dc_1", "f_dc_2")):
    rest = [f"f_rest_{i}" for i in range(3 * raw.features_rest.shape[1])]
    nxyz = ["nx", "ny", "nz"] if normals else []
    scale, rot = [f"scale_{i}" for i in range(3)], [f"rot_{i}" for i in range(4)]
    return ["x", "y", "z", *nxyz, *dc, *rest, "opacity", *scale, *rot]


def table(raw, normals=False):
    """All values in the order of `names`; f_rest channel by channel, as INRIA's code stores it."""
    rest = [raw.features_rest[:, k, c] for c in range(3) for k in range(raw.features_rest.shape[1])]
    columns = [
        raw.means,
        *([torch.zeros(len(raw), 3)] if normals else []),
        raw.features_dc,
        *(r[:, None] for r in rest),
    ]
    return torch.cat([*columns, raw.opacities, raw.scales, raw.quats], 1)


def write(path, columns, values, form="binary_little_endian", comments=(), kind="float", element="vertex", count=None):
    """A PLY written by hand."""
    count = len(values) if count is None else count
    lines = ["ply", f"format {form} 1.0", *(f"comment {c}" for c in comments), f"element {element} {count}"]
    lines += [f"property {kind} {name}" for name in columns]
    code = {"float": "f", "double": "d"}[kind]
    if form == "ascii":
        body = "".join(" ".join(f"{v:.9g}" for v in row) + "\n" for row in values.tolist()).encode()
    else:
        order = "<" if "little" in form else ">"
        body = b"".join(struct.pack(f"{order}{len(row)}{code}", *row) for row in values.tolist())
    path.write_bytes(("\n".join(lines) + "\nend_header\n").encode() + body)
    return path


# -- what others write ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("degree", range(5))
def test_every_encoding_and_degree(tmp_path, form, degree):
    raw = gaussians(degree=degree)
    read, summary = read_ply(write(tmp_path / "a.ply", names(raw), table(raw), form))
    same(read, raw)
    assert read.sh_degree == summary.sh_degree == degree
    assert summary.encoding == form.replace("_", " ") and summary.count == 12


def test_doubles_become_floats(tmp_path):
    raw = gaussians()
    same(read_ply(write(tmp_path / "a.ply", names(raw), table(raw).double(), kind="double"))[0], raw)


def test_inria(tmp_path):
    raw = gaussians()
    read, summary = read_ply(write(tmp_path / "a.ply", names(raw, normals=True), table(raw, normals=True)))
    same(read, raw)
    assert summary.source == "INRIA's 3D Gaussian splatting" and summary.antialiased is None and not summary.ignored


def test_gsplat(tmp_path):
    raw = gaussians()
    _, summary = read_ply(write(tmp_path / "a.ply", names(raw), table(raw)))
    assert summary.source == "gsplat"


@pytest.mark.parametrize("mode", ["sh_coeffs", "rgb"])
def test_nerfstudios_own_writer(tmp_path, mode):
    from nerfstudio.scripts.exporter import ExportGaussianSplat

    raw = gaussians()
    columns = table(raw, normals=True).numpy()
    tensors = OrderedDict(zip(names(raw, normals=True), columns.T, strict=True))
    rgb = np.random.default_rng(0).integers(0, 256, (3, 12), dtype=np.uint8)
    if mode == "rgb":
        tensors = OrderedDict((k, v) for k, v in tensors.items() if not k.startswith("f_"))
        tensors.update(zip(("red", "green", "blue"), rgb, strict=True))
    ExportGaussianSplat.write_ply(str(tmp_path / "a.ply"), 12, tensors)
    read, summary = read_ply(tmp_path / "a.ply")
    assert summary.source == "nerfstudio"
    if mode == "sh_coeffs":
        same(read, raw)
    else:
        assert summary.sh_degree == 0 and summary.remarks == ("Colours are 8-bit RGB, not harmonics.",)
        torch.testing.assert_close(C0 * read.features_dc + 0.5, torch.from_numpy(rgb.T / 255.0).float())


@pytest.mark.parametrize(
    "comment, source",
    [("Generated by SuperSplat 2.6.2", "SuperSplat"), ("Exported from Brush", "Brush"), ("by hand", "unknown")],
)
def test_the_source_is_told_by_a_comment(tmp_path, comment, source):
    raw = gaussians()
    assert read_ply(write(tmp_path / "a.ply", names(raw), table(raw), comments=[comment]))[1].source == source


@pytest.mark.parametrize(
    "comments, antialiased",
    [
        ([], None),
        (["SplatRenderMode: mip"], True),
        (["splatrendermode:DEFAULT"], False),
        (["SplatRenderMode: default", "SplatRenderMode: mip"], True),
        (["antialiased 1"], True),
        (["antialiased 0"], False),
        (["antialiased colours, perhaps"], None),
    ],
)
def test_opacity_compensation_is_told_by_a_comment(tmp_path, comments, antialiased):
    raw = gaussians()
    assert read_ply(write(tmp_path / "a.ply", names(raw), table(raw), comments=comments))[1].antialiased is antialiased


def test_more_properties_and_elements_are_named_and_left_out(tmp_path):
    raw = gaussians(3)
    vertex = np.zeros(3, dtype=[(name, "f4") for name in [*names(raw), "state"]])
    for i, name in enumerate(names(raw)):
        vertex[name] = table(raw)[:, i]
    camera = np.zeros(2, dtype=[("focal", "f4")])
    elements = [plyfile.PlyElement.describe(vertex, "vertex"), plyfile.PlyElement.describe(camera, "camera")]
    plyfile.PlyData(elements).write(str(tmp_path / "a.ply"))
    read, summary = read_ply(tmp_path / "a.ply")
    same(read, raw)
    assert summary.ignored == ("state", "element camera")


def test_the_order_of_properties_does_not_matter(tmp_path):
    raw = gaussians()
    order = torch.randperm(len(names(raw)), generator=torch.Generator().manual_seed(0))
    path = write(tmp_path / "a.ply", [names(raw)[i] for i in order], table(raw)[:, order])
    same(read_ply(path)[0], raw)


def test_windows_line_ends_in_the_header(tmp_path):
    raw = gaussians()
    path = write(tmp_path / "a.ply", names(raw), table(raw))
    header, body = path.read_bytes().split(b"end_header\n", 1)
    path.write_bytes((header + b"end_header\n").replace(b"\n", b"\r\n") + body)
    same(read_ply(path)[0], raw)


# -- writing ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", range(5))
@pytest.mark.parametrize("normals", [True, False])
def test_what_is_written_comes_back_bit_for_bit(tmp_path, degree, normals):
    raw = gaussians(50, degree)
    # the smallest and the largest numbers too
    raw.means[0], raw.opacities[1] = torch.tensor([1e-45, -0.0, 3.4e38]), -87.0
    write_ply(tmp_path / "a.ply", raw, normals=normals)
    same(read_ply(tmp_path / "a.ply")[0], raw)


@pytest.mark.parametrize("largest", [3, 255, 256, 70_000])
def test_levels_and_decay_come_back(tmp_path, largest):
    level = torch.arange(12, dtype=torch.int32) + 1
    level[-1] = largest
    raw = gaussians(level=level, decay=torch.linspace(-1, 9, 12))
    write_ply(tmp_path / "a.ply", raw)
    read, summary = read_ply(tmp_path / "a.ply")
    same(read, raw)
    assert summary.has_level and summary.has_decay


@pytest.mark.parametrize("antialiased", [True, False, None])
def test_the_summary_says_what_was_written(tmp_path, antialiased):
    write_ply(tmp_path / "a.ply", gaussians(1234, 2), antialiased=antialiased, comments=["scene frame"])
    _, summary = read_ply(tmp_path / "a.ply")
    assert summary.source == "freqgs" and summary.antialiased is antialiased
    mode = {True: "antialiased", False: "not antialiased", None: "antialiased or not: the file does not say"}
    assert str(summary) == (
        f"{tmp_path / 'a.ply'}: 1,234 Gaussians; SH degree 2; {mode[antialiased]}; binary little endian, "
        "probably by freqgs."
    )


def test_the_header_is_inrias(tmp_path):
    raw = gaussians(2)
    write_ply(tmp_path / "a.ply", raw, antialiased=True)
    header = (tmp_path / "a.ply").read_bytes().split(b"end_header")[0].decode().splitlines()
    expected = [f"property float {name}" for name in names(raw, normals=True)]
    assert header[:5] == [
        "ply",
        "format binary_little_endian 1.0",
        "comment Generated by freqgs",
        "comment SplatRenderMode: mip",
        "element vertex 2",
    ]
    assert header[5:] == expected


@pytest.mark.parametrize("degree", range(5))
def test_its_size_is_what_budgets_count_with(tmp_path, degree):
    sizes = []
    for n in (10, 110):
        write_ply(tmp_path / "a.ply", gaussians(n, degree, decay=torch.ones(n)), comments=["0" * (n < 100)])
        sizes.append((tmp_path / "a.ply").stat().st_size)
    assert sizes[1] - sizes[0] == 100 * bytes_per_gaussian("ply", degree, decay=True)


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    write_ply(tmp_path / "a.ply", gaussians(3))
    before = (tmp_path / "a.ply").read_bytes()

    def full(self, stream):
        stream.write(b"ply")
        raise OSError("no space left on device")

    monkeypatch.setattr(plyfile.PlyData, "write", full)
    with pytest.raises(OSError, match="no space left"):
        write_ply(tmp_path / "a.ply", gaussians(4))
    assert (tmp_path / "a.ply").read_bytes() == before and os.listdir(tmp_path) == ["a.ply"]


@pytest.mark.parametrize("comment", ["two\nlines", "Ⅱ"])
def test_comments_that_a_header_cannot_hold(tmp_path, comment):
    with pytest.raises(ValueError, match="must be one line of ASCII"):
        write_ply(tmp_path / "a.ply", gaussians(3), comments=[comment])
    assert not os.listdir(tmp_path)


# -- what is refused --------------------------------------------------------------------------------------------------


def refused(path, match):
    with pytest.raises(SplatFileError, match=match) as error:
        read_ply(path)
    assert str(path) in str(error.value)


def test_a_missing_file(tmp_path):
    with pytest.raises(FileNotFoundError, match="is no file; name a 3DGS PLY"):
        read_ply(tmp_path / "none.ply")


def test_an_empty_file(tmp_path):
    (tmp_path / "a.ply").touch()
    refused(tmp_path / "a.ply", r"is empty \(0 bytes\)")


def test_another_kind_of_file(tmp_path):
    (tmp_path / "a.ply").write_bytes(b"\x1f\x8b\x08\x00 gzip")
    refused(tmp_path / "a.ply", r"is no PLY file: it begins with b'\\x1f.* make a PLY first")


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_a_truncated_file(tmp_path, form):
    raw = gaussians(100)
    path = write(tmp_path / "a.ply", names(raw), table(raw), form)
    content = path.read_bytes()
    for keep in (0.99, 0.5):
        path.write_bytes(content[: int(keep * len(content))])
        refused(path, "(is truncated|cannot be parsed).*copy or export it again")


def test_a_truncated_header(tmp_path):
    (tmp_path / "a.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 5\nproperty float x\n")
    refused(tmp_path / "a.ply", "is truncated.*early end-of-file")


def test_an_endless_header(tmp_path):
    """To parse it takes as long as it likes."""
    head = b"ply\nformat binary_little_endian 1.0\n" + b"comment no end\n" * 80_000
    (tmp_path / "a.ply").write_bytes(head)
    refused(tmp_path / "a.ply", "has no end_header in its first 1,048,576 bytes.*export it again")


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_a_count_that_no_memory_holds(tmp_path, form):
    raw = gaussians(3)
    refused(write(tmp_path / "a.ply", names(raw), table(raw), form, count=10**15), "is truncated|cannot be parsed")


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_no_gaussians(tmp_path, form):
    raw = gaussians(1)
    refused(write(tmp_path / "a.ply", names(raw), table(raw)[:0], form), "holds no Gaussians")


def test_nonsense_in_the_header(tmp_path):
    (tmp_path / "a.ply").write_bytes(b"ply\nformat quantum 1.0\nend_header\n")
    refused(tmp_path / "a.ply", "cannot be parsed")
    (tmp_path / "a.ply").write_bytes("ply\nformat ascii 1.0\ncomment größer\nend_header\n".encode())
    refused(tmp_path / "a.ply", "cannot be parsed")


def test_a_compressed_file(tmp_path):
    chunk = np.zeros(1, dtype=[("min_x", "f4"), ("max_x", "f4")])
    packed = np.zeros(3, dtype=[("packed_position", "u4"), ("packed_rotation", "u4")])
    elements = [plyfile.PlyElement.describe(chunk, "chunk"), plyfile.PlyElement.describe(packed, "vertex")]
    plyfile.PlyData(elements).write(str(tmp_path / "a.compressed.ply"))
    refused(tmp_path / "a.compressed.ply", "is a compressed PLY.*splat-transform IN.compressed.ply OUT.ply")


def test_a_mesh_and_a_point_cloud(tmp_path):
    vertex = np.zeros(3, dtype=[("x", "f4"), ("y", "f4"), ("z", "f4")])
    face = np.array([([0, 1, 2],)], dtype=[("vertex_indices", "O")])
    cloud = plyfile.PlyElement.describe(vertex, "vertex")
    mesh = plyfile.PlyElement.describe(face, "face", val_types={"vertex_indices": "i4"})
    plyfile.PlyData([cloud, mesh]).write(str(tmp_path / "mesh.ply"))
    refused(tmp_path / "mesh.ply", "is a mesh: its vertices have x, y, z, no opacity.*ns-export gaussian-splat")
    plyfile.PlyData([cloud]).write(str(tmp_path / "cloud.ply"))
    refused(tmp_path / "cloud.ply", "is a point cloud")


def test_another_element(tmp_path):
    raw = gaussians(3)
    path = write(tmp_path / "a.ply", names(raw), table(raw), element="splat")
    refused(path, r"has no element 'vertex' but \['splat'\]")


@pytest.mark.parametrize("missing", [["opacity"], ["y"], ["rot_3"], ["scale_0", "scale_1"], ["f_dc_2"]])
def test_missing_properties_are_named(tmp_path, missing):
    raw = gaussians(3)
    keep = [i for i, name in enumerate(names(raw)) if name not in missing]
    path = write(tmp_path / "a.ply", [names(raw)[i] for i in keep], table(raw)[:, keep])
    refused(path, f"lacks the properties {', '.join(missing)}; export it")


def test_flat_gaussians(tmp_path):
    raw = gaussians(3)
    keep = [i for i, name in enumerate(names(raw)) if name != "scale_2"]
    path = write(tmp_path / "a.ply", [names(raw)[i] for i in keep], table(raw)[:, keep])
    refused(path, "no property scale_2: it holds flat Gaussians")
    path = write(tmp_path / "a.ply", names(raw), table(raw), comments=["SplatRenderMode: 2dgs"])
    refused(path, "SplatRenderMode '2dgs'")


@pytest.mark.parametrize("drop", [["f_rest_44"], ["f_rest_0"], ["f_rest_3", "f_rest_4", "f_rest_5"]])
def test_a_number_of_harmonics_that_is_no_degree(tmp_path, drop):
    raw = gaussians(3)
    keep = [i for i, name in enumerate(names(raw)) if name not in drop]
    path = write(tmp_path / "a.ply", [names(raw)[i] for i in keep], table(raw)[:, keep])
    refused(path, rf"has {45 - len(drop)} properties f_rest_\*; there must be 0, 9, 24, 45, 72")


def test_harmonics_that_are_numbered_wrongly(tmp_path):
    raw = gaussians(3, 1)
    columns = [name.replace("f_rest_8", "f_rest_9") for name in names(raw)]
    refused(write(tmp_path / "a.ply", columns, table(raw)), "numbered from 0")


def test_sizes_that_would_be_infinite(tmp_path):
    raw = gaussians()
    values = table(raw)
    values[[2, 5], names(raw).index("scale_1")] = 88.5
    refused(write(tmp_path / "a.ply", names(raw), values), r"scale_1 of 2 of 12 Gaussians is over 88 \(up to 88.5\)")
    values[[2, 5], names(raw).index("scale_1")] = 87.0
    read, _ = read_ply(write(tmp_path / "b.ply", names(raw), values))
    assert torch.isfinite(read.scales.exp()).all()


@pytest.mark.parametrize("name", ["x", "scale_1", "rot_0", "opacity", "f_dc_2", "f_rest_17"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_values_that_are_not_finite(tmp_path, name, value, form):
    raw = gaussians()
    values = table(raw)
    values[[2, 5], names(raw).index(name)] = value
    path = write(tmp_path / "a.ply", names(raw), values, form)
    refused(path, f"property {name} of 2 of 12 Gaussians is NaN or infinite. Remove them, .*--filter-nan")


def test_doubles_beyond_float32(tmp_path):
    raw = gaussians()
    values = table(raw).double()
    values[3, 0] = 1e300
    refused(write(tmp_path / "a.ply", names(raw), values, kind="double"), "property x of 1 of 12 Gaussians")


def test_zero_quaternions(tmp_path):
    raw = gaussians()
    raw.quats[4] = 0
    refused(write(tmp_path / "a.ply", names(raw), table(raw)), "quaternion rot_0..rot_3 of 1 of 12 Gaussians is zero")


@pytest.mark.parametrize("bad", [0, -1, 1.5])
def test_levels_begin_with_one(tmp_path, bad):
    raw = gaussians(3)
    values = torch.cat([table(raw), torch.tensor([[1.0], [bad], [2.0]])], 1)
    path = write(tmp_path / "a.ply", [*names(raw), "level"], values)
    refused(path, rf"property level of 1 Gaussians is not a whole number from 1 on \(for instance {bad:g}\)")


def test_list_properties(tmp_path):
    raw = gaussians(2)
    columns = [(name, "f4") for name in names(raw) if name != "opacity"]
    vertex = np.zeros(2, dtype=[*columns, ("opacity", "O")])
    vertex["opacity"] = [np.zeros(1, "f4"), np.zeros(2, "f4")]
    element = plyfile.PlyElement.describe(vertex, "vertex", val_types={"opacity": "f4"})
    plyfile.PlyData([element]).write(str(tmp_path / "a.ply"))
    refused(tmp_path / "a.ply", "property opacity is a list")


def test_activated_parameters(tmp_path):
    raw = gaussians()
    active = replace(raw, scales=raw.scales.exp(), opacities=raw.opacities.sigmoid())
    refused(write(tmp_path / "a.ply", names(raw), table(active)), "seems to hold activated parameters.*convert them")
    for half, words in (
        (replace(raw, opacities=active.opacities), "taken as logits"),
        (replace(raw, scales=active.scales), "taken as logarithms"),
    ):
        read, summary = read_ply(write(tmp_path / "a.ply", names(raw), table(half)))
        same(read, half)
        assert words in summary.remarks[0] and summary.remarks[0] in str(summary)


def test_few_gaussians_are_not_judged(tmp_path):
    raw = gaussians(2)
    raw = replace(raw, scales=raw.scales.exp(), opacities=raw.opacities.sigmoid())
    same(read_ply(write(tmp_path / "a.ply", names(raw), table(raw)))[0], raw)
