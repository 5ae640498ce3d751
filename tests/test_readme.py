"""The README's Python runs as it stands there, but for shorter trainings, and its tables are what was measured."""

import importlib.util
import re
from pathlib import Path

import pytest

README = Path(__file__).parents[1] / "README.md"
BLOCKS = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), flags=re.DOTALL)


@pytest.mark.slow
@pytest.mark.parametrize("block", BLOCKS, ids=[block.splitlines()[0] for block in BLOCKS])
def test_a_block_runs(block):
    shorter = re.sub(r"total_steps=[\d_]+", "total_steps=400", block).replace("config, 100)", "config, 2)")
    assert shorter != block
    exec(compile(shorter, str(README), "exec"), {})


def test_tables_are_the_measured_ones():
    path = README.parent / "benchmarks" / "readme.py"
    spec = importlib.util.spec_from_file_location("readme", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert README in module.PAGES
    for page in module.PAGES:
        assert module.embedded(page.read_text(encoding="utf-8")) == page.read_text(encoding="utf-8")
