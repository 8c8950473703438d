"""Writes the options table of README.md from the config's fields: `python docs/options_table.py`.

A test compares the two; run this after a default or a docstring has changed.
"""

import ast
import inspect
import textwrap
from dataclasses import fields
from pathlib import Path

README = Path(__file__).parent.parent / "README.md"
BEGIN, END = "<!-- options: written by docs/options_table.py -->", "<!-- end of options -->"


def docstrings(config_class: type) -> dict[str, str]:
    """Public fields that the class itself defines, in order -> the string literal below each; "" without one."""
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(config_class))).body
    assert isinstance(tree, ast.ClassDef)
    found = {}
    for node, below in zip(tree.body, [*tree.body[1:], None], strict=True):
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.target.id[0] != "_":
            text = below.value.value if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant) else ""
            found[node.target.id] = inspect.cleandoc(str(text)).replace("\n", " ")
    return found


def table() -> str:
    """Markdown: the fields that this package defines, with their defaults: of each method, of both, of photographs."""
    from freqgs_plugin.studio.config import FreqSplatModelConfig
    from freqgs_plugin.studio.datamanager import SceneDatamanagerConfig
    from method_configs.clodsplat import clodsplat
    from method_configs.lapsplat import lapsplat

    methods = {m.config.method_name: m.config.pipeline.model for m in (lapsplat, clodsplat)}
    shared = docstrings(FreqSplatModelConfig)
    parts = []
    for name, config in methods.items():
        parts.append(f"`{name}`:\n\n{_rows(docstrings(type(config)), [config])}")
    parts.append(f"Both methods:\n\n{_rows(shared, list(methods.values()))}")
    images = SceneDatamanagerConfig()
    parts.append(f"Photographs (`--pipeline.datamanager.`):\n\n{_rows(docstrings(type(images)), [images])}")
    return "\n\n".join(parts)


def _rows(meaning: dict[str, str], configs: list) -> str:
    """A table; a default that differs between `configs` is given for each of them, in order."""
    rows = ["| option | default | meaning |", "| --- | --- | --- |"]
    for name, text in meaning.items():
        assert all(name in {f.name for f in fields(config)} for config in configs)
        defaults = dict.fromkeys(f"`{getattr(config, name)}`" for config in configs)
        rows.append(f"| `{name.replace('_', '-')}` | {' / '.join(defaults)} | {text.replace('|', chr(92) + '|')} |")
    return "\n".join(rows)


def with_table(readme: str) -> str:
    """README text with the part between the markers made anew."""
    before, rest = readme.split(BEGIN)
    return f"{before}{BEGIN}\n{table()}\n{END}{rest.split(END)[1]}"


if __name__ == "__main__":
    README.write_text(with_table(README.read_text(encoding="utf-8")), encoding="utf-8")
