"""The code on docs/applications.md, run as it is written."""

import re
from pathlib import Path

import pytest

from freqgs_plugin.cli import main

PAGE = Path(__file__).parents[2] / "docs" / "applications.md"


@pytest.mark.slow
def test_the_code_on_the_page_runs(trained, tmp_path, monkeypatch, capsys):
    (tmp_path / "RUN").symlink_to(trained.parent, target_is_directory=True)
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.S)
    assert len(blocks) == 9
    names = {}
    for block in blocks:
        exec(compile(block, str(PAGE), "exec"), names)
    assert (tmp_path / "level-1.png").stat().st_size > 0
    out = capsys.readouterr().out
    assert re.search(r"^[\d,]+ of [\d,]+ Gaussians$", out, flags=re.M)
    assert re.search(r"^[1-9]\d* Gaussians, \d+ pixels of this view$", out, flags=re.M)
    assert re.search(r"^kept [1-9]\d* Gaussians: the mask is empty", out, flags=re.M)
    assert names["picture"].features.shape[:2] == (names["camera"].height, names["camera"].width)
    assert names["distance"].min() >= 0 and (names["run"].gaussians.level[names["row"]] == 1).all()


@pytest.mark.slow
def test_a_filter_of_ones_own_as_the_page_has_it(trained, tmp_path, monkeypatch):
    (tmp_path / "RUN").symlink_to(trained.parent, target_is_directory=True)
    monkeypatch.chdir(tmp_path)
    text = PAGE.read_text(encoding="utf-8").split("### A filter of one's own")[1]
    (tmp_path / "own.py").write_text(re.search(r"```python\n(.*?)```", text, flags=re.S)[1])
    lines = re.search(r"```bash\n(.*?)```", text, flags=re.S)[1].splitlines()
    assert len(lines) == 2
    for line in lines:
        program, *arguments = line.split()
        assert program == "freqgs"
        # the folder's name as it was made, which says of what method the run is
        main([str(trained) if word == "RUN/config.yml" else word for word in arguments])
    assert (tmp_path / "own.png").stat().st_size > 0 and len(list((tmp_path / "own").glob("*.png"))) == 3
