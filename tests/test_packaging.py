"""What an installation consists of: entry points, light imports, a complete wheel, a README that tells the truth."""

import functools
import importlib.util
import inspect
import os
import re
import shlex
import shutil
import subprocess
import sys
from importlib.metadata import distribution, entry_points
from pathlib import Path

import pytest
import torch
import tyro

from freqgs_plugin import cli
from freqgs_plugin.rendering.base import ENTRY_POINT_GROUP, available_rasterizers, get_rasterizer
from freqgs_plugin.types import Camera, Splats

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
OURS = [e for e in distribution("freqgs-plugin").entry_points if e.group == "nerfstudio.method_configs"]
METHODS = ["clodsplat", "clodsplat-paper", "lapsplat", "lapsplat-paper", "lapsplat-plain"]
PLACES = {"SCENE": "scene", "RUN": "run", "PATH.json": "path.json"}
"""placeholders in README commands"""


def python(code, folder=None, **environment):
    """Standard output of `code` in a process of its own, which has none of the tests' import hooks."""
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code],
        capture_output=True,
        text=True,
        timeout=240,
        cwd=folder,
        env={**os.environ, **environment},
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout.strip()


def options_table():
    spec = importlib.util.spec_from_file_location("options_table", ROOT / "docs" / "options_table.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("entry", OURS, ids=lambda e: e.name)
def test_methods_are_specifications_by_their_name(entry):
    from nerfstudio.plugins.types import MethodSpecification

    method = entry.load()
    assert isinstance(method, MethodSpecification)
    assert method.config.method_name == entry.name
    assert method.description


def test_registered_are_the_methods_that_train():
    assert sorted(e.name for e in OURS) == METHODS
    assert [e.name for e in entry_points(group="console_scripts") if e.value.startswith("freqgs_plugin")] == ["freqgs"]


def test_importing_the_package_pulls_in_neither_nerfstudio_nor_cuda():
    code = (
        "import sys, freqgs_plugin\n"
        "torch = sys.modules.get('torch')\n"
        "print('nerfstudio' in sys.modules, 'gsplat' in sys.modules, torch is not None and torch.cuda.is_initialized())"
    )
    assert python(code) == "False False False"


def test_ns_train_starts_as_quickly_with_the_plugin():
    # nerfstudio imports every method's config whatever one asks for
    code = """
import sys, time
from importlib import metadata
found = metadata.entry_points
def without_methods(**kwargs):
    return metadata.EntryPoints() if kwargs.get("group") == "nerfstudio.method_configs" else found(**kwargs)
metadata.entry_points = without_methods
start = time.process_time()
import nerfstudio.scripts.train
alone = time.process_time() - start
before = set(sys.modules)
start = time.process_time()
import method_configs.clodsplat, method_configs.lapsplat
added = time.process_time() - start
heavy = ("kornia", "pycolmap", "skimage", "sklearn", "matplotlib.pyplot", "numba", "torchmetrics", "torchvision",
         "gsplat.cuda._backend")
print([name for name in heavy if name in sys.modules and name not in before])
print(added, alone)
"""
    modules, seconds = python(code).splitlines()
    assert modules == "[]", "import these when they are first used"
    added, alone = (float(s) for s in seconds.split())
    assert added < 0.1 * alone, f"{added:.2f} s on top of {alone:.2f} s"


def test_every_config_field_has_a_docstring():
    from freqgs_plugin.studio.clodsplat import ClodSplatModelConfig
    from freqgs_plugin.studio.config import FreqSplatModelConfig
    from freqgs_plugin.studio.datamanager import SceneDatamanagerConfig
    from freqgs_plugin.studio.lapsplat import LapSplatModelConfig
    from method_configs.optimizers import FusedAdamConfig

    described = {SceneDatamanagerConfig: {"cache_images_type"}}  # nerfstudio's own docstring holds
    ours = (LapSplatModelConfig, ClodSplatModelConfig, FreqSplatModelConfig, SceneDatamanagerConfig, FusedAdamConfig)
    for config in ours:
        fields = options_table().docstrings(config)
        missing = [name for name, text in fields.items() if not text and name not in described.get(config, set())]
        assert fields and not missing, f"{config.__name__}: {missing}"


def test_the_readmes_options_are_the_configs():
    assert options_table().with_table(README) == README, "run `python docs/options_table.py`"


def commands():
    """Commands of the README's bash blocks, joined by && or not."""
    blocks = re.findall(r"```bash\n(.*?)```", README, flags=re.DOTALL)
    lines = [part.strip() for block in blocks for line in block.splitlines() for part in line.split("&&")]
    return [line for line in lines if line]


def parse_nerfstudio(program, arguments):
    from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion
    from nerfstudio.scripts import eval as evaluation
    from nerfstudio.scripts import exporter, render
    from nerfstudio.scripts.viewer import run_viewer

    what = {
        "ns-train": AnnotatedBaseConfigUnion,
        "ns-eval": evaluation.ComputePSNR,
        "ns-render": render.Commands,
        "ns-export": exporter.Commands,
        "ns-viewer": run_viewer.RunViewer,
    }[program]
    return tyro.cli(what, args=arguments)  # pyright: ignore


@pytest.mark.parametrize("command", [c for c in commands() if c.startswith("ns-")])
def test_nerfstudio_takes_the_readmes_commands(command):
    for place, value in PLACES.items():
        command = re.sub(rf"\b{re.escape(place)}\b", value, command)
    program, *arguments = shlex.split(command)
    assert parse_nerfstudio(program, arguments) is not None


@pytest.mark.parametrize("command", [c for c in commands() if c.startswith("freqgs")])
def test_freqgs_takes_the_readmes_commands(command, monkeypatch):
    called = []

    def recorder(name, function):
        @functools.wraps(function)
        def record(*_, **__):
            called.append(name)

        return record

    monkeypatch.setattr(cli, "COMMANDS", {name: recorder(name, f) for name, f in cli.COMMANDS.items()})
    arguments = shlex.split(command)[1:]
    cli.main(arguments)
    assert called == arguments[:1]


def test_the_readmes_setup_is_what_the_checks_run():
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    (install, run), others = commands()[6:8], [c for c in commands() if not c.startswith(("ns-", "freqgs"))]
    assert install == "pip install -e '.[test,docs]'" and install.removeprefix("pip install ") in script
    assert run == "pytest -n 2 --dist loadfile" and f"\n{run}\n" in script
    assert len(others) == 7
    assert os.access(ROOT / ".ci" / "run", os.X_OK)


@pytest.mark.parametrize("page", ["README.md", *(f"docs/{p.name}" for p in sorted((ROOT / "docs").glob("*.md")))])
def test_links_and_pictures_are_there(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    targets = re.findall(r"\]\(([^)#]+)", text)
    missing = [t for t in targets if "://" not in t and not ((ROOT / page).parent / t).exists()]
    assert not missing


def test_dependencies_are_what_is_imported():
    names = {"cv2": "opencv-contrib-python-headless", "PIL": "pillow", "skimage": "scikit-image", "yaml": "pyyaml"}
    sources = [p for folder in ("freqgs_plugin", "method_configs") for p in (ROOT / folder).rglob("*.py")]
    pattern = re.compile(r"^\s*(?:import|from) (\w+)", flags=re.MULTILINE)
    modules = {m for p in sources for m in pattern.findall(re.sub(r'""".*?"""', "", p.read_text("utf-8"), flags=re.S))}
    ours = {"freqgs_plugin", "method_configs"}
    imported = {names.get(m, m.replace("_", "-")) for m in modules - ours - set(sys.stdlib_module_names)}
    (block,) = re.findall(
        r"^dependencies = \[\n(.*?)^\]", (ROOT / "pyproject.toml").read_text("utf-8"), flags=re.M | re.S
    )
    declared = set(re.findall(r'^    "([\w-]+)', block, flags=re.MULTILINE))
    project = (ROOT / "pyproject.toml").read_text("utf-8")
    (extra,) = re.findall(r"^prompt = \[(.*?)\]", project, flags=re.MULTILINE)
    optional = set(re.findall(r'"([\w-]+)', extra))
    assert optional == {"transformers"} and imported - declared == optional, "imported, not declared"
    where = [
        p.name for p in sources if re.search(r"^\s*(?:import|from) transformers", p.read_text("utf-8"), re.MULTILINE)
    ]
    assert where == ["clipseg.py"], "nothing else may need an extra"
    # loaded by path, and kept from a version that nerfstudio cannot import everywhere
    assert declared - imported == {"tbb", "open3d"}, "declared, not imported"


def test_a_wheel_works_by_itself(tmp_path):
    source, wheels, site = tmp_path / "source", tmp_path / "wheels", tmp_path / "site"
    for folder in ("freqgs_plugin", "method_configs"):
        shutil.copytree(ROOT / folder, source / folder, ignore=shutil.ignore_patterns("__pycache__"))
    for file in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / file, source / file)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "-q"]
    build = ["wheel", "--no-deps", "--no-build-isolation", "--no-index", "-w", str(wheels), str(source)]
    subprocess.run([*pip, *build], check=True, timeout=240, capture_output=True)
    (wheel,) = wheels.glob("freqgs_plugin-*.whl")
    install = ["install", "--no-deps", "--no-index", "--target", str(site), str(wheel)]
    subprocess.run([*pip, *install], check=True, timeout=240, capture_output=True)
    written = {p.relative_to(source) for p in source.glob("[fm]*/**/*.py")}
    page = {p.relative_to(source) for p in source.glob("freqgs_plugin/stream/page/*")}
    assert page and all((site / path).is_file() for path in page)
    assert written and written <= {p.relative_to(site) for p in site.rglob("*.py")}
    code = (
        "from importlib.metadata import distribution\n"
        "import freqgs_plugin.cli\n"
        "entries = distribution('freqgs-plugin').entry_points\n"
        "for e in entries: e.load()\n"
        "import method_configs.lapsplat as m\n"
        "print(freqgs_plugin.cli.__file__, m.__file__, sorted(e.name for e in entries))"
    )
    one, other, *names = python(code, tmp_path, PYTHONPATH=str(site)).split(" ", 2)
    assert one.startswith(str(site)) and other.startswith(str(site))
    assert names == [str(sorted(["freqgs", *METHODS]))]


def test_the_rasterizer_of_the_documentation_works(tmp_path, monkeypatch):
    text = (ROOT / "docs" / "backends.md").read_text(encoding="utf-8")
    (source,) = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    (group, entry) = re.search(r'```toml\n\[project.entry-points."(.*?)"\]\n(.*?)```', text, flags=re.DOTALL).groups()  # pyright: ignore
    assert group == ENTRY_POINT_GROUP
    (tmp_path / "my_rasterizer.py").write_text(source)
    info = tmp_path / "my_rasterizer-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-rasterizer\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[{group}]\n{entry.replace(chr(34), '')}")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert "preview" in available_rasterizers()
    rasterizer = get_rasterizer("preview", "cpu", absgrad=False)
    assert inspect.signature(type(rasterizer).__call__) and rasterizer.name == "preview"
    one = torch.ones(1)
    means = torch.tensor([[0.0, 0.0, 2.0]], requires_grad=True)
    splats = Splats(means, torch.eye(4)[:1], 0.1 * torch.ones(1, 3), 0.9 * one, torch.ones(1, 3))
    camera = Camera(torch.eye(4), torch.tensor([[20.0, 0, 9.5], [0, 20.0, 6.5], [0, 0, 1]]), 19, 13)
    rendering = rasterizer(splats, camera, background=torch.zeros(3))
    assert rendering.features.shape == (13, 19, 3) and rendering.alpha.max() > 0.5
    assert rendering.depth[6, 9] == pytest.approx(2.0)
    rendering.features.sum().backward()
    assert means.grad is not None and torch.isfinite(means.grad).all()
