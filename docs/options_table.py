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
    """Markdown: one row per field that this package defines, with the default of `ns-train lapsplat`."""
    from freqgs_plugin.studio.lapsplat import LapSplatModelConfig
    from freqgs_plugin.studio.model import FreqSplatModelConfig
    from method_configs.lapsplat import lapsplat

    config = lapsplat.config.pipeline.model
    meaning = {**docstrings(LapSplatModelConfig), **docstrings(FreqSplatModelConfig)}
    assert meaning.keys() <= {f.name for f in fields(config)}
    rows = ["| option | default | meaning |", "| --- | --- | --- |"]
    for name, text in meaning.items():
        cells = (f"`{name.replace('_', '-')}`", f"`{getattr(config, name)}`", text.replace("|", "\\|"))
        rows.append(f"| {' | '.join(cells)} |")
    return "\n".join(rows)


def with_table(readme: str) -> str:
    """README text with the part between the markers made anew."""
    before, rest = readme.split(BEGIN)
    return f"{before}{BEGIN}\n{table()}\n{END}{rest.split(END)[1]}"


if __name__ == "__main__":
    README.write_text(with_table(README.read_text(encoding="utf-8")), encoding="utf-8")
