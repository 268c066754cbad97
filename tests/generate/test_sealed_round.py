"""The sealed round of docs/methods.md by its own commands, on a small task."""

import os
import re
import shlex
from pathlib import Path

from texts import text

from vsfsim.bench.result import Result
from vsfsim.bench.task import load_task

PAGE = (Path(__file__).parents[2] / "docs" / "methods.md").read_text().split("## A sealed round")[1].split("\n## ")[0]


def test_the_page_goes_through_a_round(generated, vsfsim, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("round").mkdir()
    Path("sprung-v1.toml").write_text(text("sprung-v1"))
    Path("data").mkdir()
    for place in (Path("data/sprung"), Path("round/data")):
        place.symlink_to(generated("sprung").path)
    monkeypatch.setenv("VSFSIM_DATASETS", str(tmp_path / "data"))
    blocks = re.findall(r"```(bash|python)\n(.*?)```", PAGE.replace("fewshot-shoes-v3-v1", "sprung-v1.toml"), re.DOTALL)
    assert [kind for kind, _ in blocks] == ["bash", "python", "bash"]
    said = []
    for kind, block in blocks:
        if kind == "python":
            exec(compile(block, "docs/methods.md", "exec"), {})
            continue
        for line in block.splitlines():
            words = shlex.split(line)
            if words[1] != "generate":  # the data are there, and not of a secret seed
                found = vsfsim(*words[1:], cwd=tmp_path)
                assert found.returncode == 0, found.stderr
                said.append(found.stdout)
    commitment = re.search(r"commitment to publish: (\w{64})", said[0])[1]
    assert "a seed with 12 digits or more" in said[0] and f"commitment: {commitment}" in said[1]
    assert re.search(r"receipt: \w{64}", said[1])
    row = Result.load(next(Path("results").rglob("mine.json")))
    assert row.task == "sprung-v1-sealed" and 0.0 < row.scores["rmse_ratio"]["1"].mean < 1.0
    public = b"".join(path.read_bytes() for path in Path("round/public").iterdir())
    assert row.dataset_sha256.encode() not in public and os.environ["VSFSIM_DATASETS"].encode() not in public


def test_a_sealed_task_tells_no_seed():
    """Neither its digest nor its data depend on it."""
    task = load_task("fewshot-shoes-v3-mini-v1")
    sealed = task.on("sealed")
    assert sealed.name == "fewshot-shoes-v3-mini-v1-sealed" == load_task(sealed.name).name
    assert load_task(sealed.name).sha256 == sealed.sha256 != task.sha256 and sealed.protocol == task.protocol
