"""`freqgs stream`, `freqgs serve` and `freqgs bench stream`, as a user calls them."""

import errno
import json
import os
import re
import signal
import subprocess
import sys
import threading
import urllib.error
import urllib.request
from dataclasses import replace
from http.server import ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import parse_qs, unquote, urlsplit

import pytest
import torch
from fake_run import fake_run, fake_views
from scenes_to_stream import small_scene

from freqgs_plugin.cli import main
from freqgs_plugin.io.parameters import RawGaussians
from freqgs_plugin.io.ply import read_ply, write_ply
from freqgs_plugin.reports.bench import stream_measure
from freqgs_plugin.reports.bench.stream_measure import Point
from freqgs_plugin.reports.bench.stream_verdict import complete_from, without_holes_from, worst_dip
from freqgs_plugin.stream.client import fetch
from freqgs_plugin.stream.manifest import MANIFEST
from freqgs_plugin.stream.server import Server


@pytest.fixture
def ply(tmp_path):
    g = small_scene(120).gaussians
    raw = RawGaussians(
        means=g.means,
        scales=g.scales.log(),
        quats=g.quats,
        features_dc=g.features_dc,
        features_rest=g.features_rest,
        opacities=g.opacities.logit()[:, None],
    )
    write_ply(tmp_path / "scene.ply", raw)
    return tmp_path / "scene.ply", g


def test_a_ply_is_streamed_and_served(ply, tmp_path, capsys):
    path, gaussians = ply
    main(["stream", str(path), "--output-dir", str(tmp_path / "out"), "--variant", "exact"])
    assert "120 Gaussians" in capsys.readouterr().out
    program = [
        sys.executable,
        "-c",
        "from freqgs_plugin.cli import main; main()",
        "serve",
        str(tmp_path),
        "--port",
        "0",
    ]
    child = subprocess.Popen(
        program,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # a shell that runs this in the background has its children ignore Ctrl-C
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        assert child.stdout is not None
        found = re.fullmatch(r"(http://127\.0\.0\.1:\d+)/\?stream=out/\n", child.stdout.readline())
        assert found, child.stderr
        fetched = fetch(f"{found[1]}/out")
        child.send_signal(signal.SIGINT)
        said, errors = child.communicate(timeout=20)
    finally:
        child.kill()
    assert child.returncode == 0 and "Stopped" in said and not errors
    received = fetched.received.gaussians()
    assert not received.signed_residuals and len(received) == 120
    assert torch.equal(received.means.sort(0).values, gaussians.means.sort(0).values)


def test_names_that_an_address_cannot_hold(ply, tmp_path, monkeypatch, capsys):
    """And a link out of the folder is not offered, as it is not served."""
    path, _ = ply
    for folder in (tmp_path / "many" / "a b#c&d é", tmp_path / "elsewhere"):
        main(["stream", str(path), "--output-dir", str(folder)])
    (tmp_path / "many" / "link").symlink_to(tmp_path / "elsewhere", target_is_directory=True)
    capsys.readouterr()
    answers = []

    def served(server):
        thread = threading.Thread(target=ThreadingHTTPServer.serve_forever, args=(server,))
        thread.start()
        try:
            for name in ("/a%20b%23c%26d%20%C3%A9/manifest.json", "/link/manifest.json", "/%00", "/x.json%00"):
                try:
                    answers.append(urllib.request.urlopen(server.url + name, timeout=20).status)
                except urllib.error.HTTPError as error:
                    answers.append(error.code)
        finally:
            server.shutdown()
            thread.join()

    monkeypatch.setattr(Server, "serve_forever", served)
    main(["serve", str(tmp_path / "many"), "--port", "0"])
    first, *_ = lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2 and first.startswith("http://127.0.0.1:")
    # as the page reads it: a parameter that is an address
    (stream,) = parse_qs(urlsplit(first).query)["stream"]
    assert unquote(stream) == "a b#c&d é/" and not set(stream) & set(" #&")
    assert answers == [200, 404, 404, 404]


@pytest.mark.parametrize("variant", ["exact", "balanced"])
def test_a_scene_without_harmonics_is_streamed(ply, tmp_path, variant):
    """Many tools leave f_rest out of a PLY whose colours do not change with the direction."""
    path, gaussians = ply
    raw = replace(read_ply(path)[0], features_rest=torch.zeros(len(gaussians), 0, 3))
    write_ply(tmp_path / "plain.ply", raw)
    assert b"f_rest" not in (tmp_path / "plain.ply").read_bytes()[:1500]
    main(["stream", str(tmp_path / "plain.ply"), "--output-dir", str(tmp_path / "out"), "--variant", variant])
    received = fetch(tmp_path / "out").received.gaussians()
    assert len(received) == 120 and received.features_rest.shape == (120, 0, 3)
    main(["stream", str(tmp_path / "plain.ply"), "--html", str(tmp_path / "plain.html"), "--variant", variant])
    assert (tmp_path / "plain.html").stat().st_size > 1000


@pytest.mark.parametrize("kind", ["folder", "html"])
def test_what_is_there_is_replaced_only_if_asked(ply, tmp_path, capsys, kind):
    out = tmp_path / "out" / "scene.html" if kind == "html" else tmp_path / "out"
    arguments = ["stream", str(ply[0]), "--html" if kind == "html" else "--output-dir", str(out)]
    main(arguments)
    before = {path: path.read_bytes() for path in (tmp_path / "out").iterdir()}
    with pytest.raises(SystemExit):
        main([*arguments, "--variant", "small"])
    assert "exists; add --overwrite" in " ".join(capsys.readouterr().err.split())
    assert {path: path.read_bytes() for path in (tmp_path / "out").iterdir()} == before
    main([*arguments, "--variant", "small", "--overwrite"])
    after = {path: path.read_bytes() for path in (tmp_path / "out").iterdir()}
    assert after != before and len(after) == len(before)


@pytest.mark.parametrize("there", [False, True])
@pytest.mark.parametrize("kind", ["folder", "manifest", "html"])
def test_a_full_disk_leaves_what_was_there(ply, tmp_path, monkeypatch, capsys, kind, there):
    out = tmp_path / "new" / "out"
    target = ["--html", str(out / "scene.html")] if kind == "html" else ["--output-dir", str(out)]
    if there:
        main(["stream", str(ply[0]), "--variant", "exact", *target])
    before = {path: path.read_bytes() for path in (tmp_path / "new").rglob("*") if path.is_file()}
    write = Path.write_bytes

    def full(path, contents):
        if kind != "manifest" or MANIFEST in path.name:
            write(path, contents[: len(contents) // 2])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(path, contents)

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(SystemExit):
        main(["stream", str(ply[0]), *target, "--overwrite"])
    assert "No space left" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in (tmp_path / "new").rglob("*") if path.is_file()} == before
    assert (tmp_path / "new").exists() == there


def test_one_file(ply, tmp_path):
    main(["stream", str(ply[0]), "--html", str(tmp_path / "deep" / "scene.html")])
    text = (tmp_path / "deep" / "scene.html").read_text()
    assert "freqgs-stream" in text and 'src="' not in text and 'href="style' not in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["stream", "missing.ply"], "missing.ply is no file"),
        (["serve", "missing"], "missing is no folder"),
        (["serve", "."], "holds no manifest.json"),
        (["serve", ".", "--mbits", "0"], "mbits is 0"),
        (["serve", "damaged"], "no manifest of a stream"),
        (["bench", "stream", "--load-config", "a", "--names", "x", "y"], "2 names for 1 runs"),
    ],
)
def test_errors_say_what_to_do(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "damaged").mkdir()
    (tmp_path / "damaged" / MANIFEST).write_text("nonsense")
    if arguments == ["serve", "."]:
        (tmp_path / "damaged" / MANIFEST).unlink()
    with pytest.raises(SystemExit):
        main(arguments)
    assert message in " ".join(capsys.readouterr().err.split())


def test_a_bench_fills_its_page(tmp_path, monkeypatch):
    run, views = fake_run(3, 150), fake_views(2)
    run.gaussians.features_rest.zero_()
    run.scene_distance, run.config = None, SimpleNamespace(experiment_name="small")
    monkeypatch.setattr(stream_measure, "load", lambda path: run)
    monkeypatch.setattr(stream_measure, "views_of", lambda run: views)
    monkeypatch.setattr(stream_measure, "views_of_split", lambda run, split: views)
    page = tmp_path / "page.md"
    page.write_text("".join(f"<!-- {n} -->\n<!-- end of {n} -->\n" for n in TABLES))
    main(["bench", "stream", "--load-config", "run", "--quick", "--docs", str(page), "--output-dir", str(tmp_path)])
    tables = json.loads((tmp_path / "stream.json").read_text())["tables"]
    rows = tables["stream-curve"]["rows"]
    # harmonics that are nothing are not sent
    expected = ["first chunk", "level 1", "without holes", "complete picture", "level 2", "level 3"]
    assert [row["what"] for row in rows] == expected
    assert all(row["covered"] >= 0.99 for row in rows[2:])
    assert [row["gaussians"] for row in rows][1:] == [50, 50, 50, 100, 150]
    (variant,), (line,) = tables["stream-variants"]["rows"], tables["stream-lines"]["rows"]
    assert rows[-1]["bytes"] == variant["bytes"] and variant["own"] > 35
    assert 0 < line["stream"]["first"] <= line["stream"]["complete"] <= line["stream"]["base"] <= line["stream"]["full"]
    assert "small" in page.read_text() and (tmp_path / "images" / "bench_stream.png").is_file()


TABLES = ("stream-curve", "stream-variants", "stream-lines")


def test_a_complete_picture_has_no_holes_and_is_near_the_base_from_then_on():
    def point(covered, complete, part="core"):
        return Point(1, part, 0, 0.0, complete, covered, 0)

    points = [point(1.0, 12.0), point(0.98, 18.0), point(1.0, 17.9), point(1.0, 18.1), point(1.0, 21.0)]
    points.append(point(1.0, 40.0, "sh"))
    # a picture of blobs has no holes, and says little
    assert (without_holes_from(points), complete_from(points)) == (2, 3)
    assert without_holes_from([point(1.0, 12.0)] * 2) == 0
    assert without_holes_from([point(0.5, 12.0)] * 2) == 1


def test_the_worst_dip():
    assert worst_dip([1.0, 3.0, 2.5, 4.0, 3.9]) == 0.5
    assert worst_dip([1.0, 1.0, 2.0]) == 0
