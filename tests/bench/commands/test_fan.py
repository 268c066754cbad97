"""Trainings that shards or a Ray cluster make give the rows of one process."""


import pytest

from vsfsim.bench.commands.catalogue import Choice
from vsfsim.bench.evaluate import evaluate, evaluate_all
from vsfsim.bench.result import Result
from vsfsim.bench.task import parse_task
from vsfsim.core.system.engines import Fan

ROW = Choice("toy_methods:Constant", "", {"value": 2.0})
FOLDS = 'protocol = { folds = 3, draws = 1, trainings = 1, shots = [0, 5], query = 4, seed = 0 }'


@pytest.fixture(scope="module")
def folded(task_text):
    before = 'protocol = { train = "train", test = "test", shots = [0, 1, 5], seeds = 3, query = 4, seed = 0 }'
    assert before in task_text
    return parse_task(task_text.replace(before, FOLDS), "toy-v1.toml")


def rows_of(result):
    return result.queries, result.scores, result.answers


def test_shards_make_the_trainings_and_the_last_call_scores_them(folded, toy_dataset, tmp_path):
    made = evaluate("toy_methods:Constant", folded, toy_dataset, parameters={"value": 2.0}, check=False)
    for k in range(2):
        assert not list(evaluate_all(folded, {tmp_path / "row.json": ROW}, dataset=toy_dataset,
                                     check=False, fan=Fan((k, 2))))
        assert not list(tmp_path.glob("*.json"))
    parts = list((tmp_path / "row.parts").glob("*/*.answers"))
    assert len(parts) == 3, "the trainings of three folds"
    (last,) = evaluate_all(folded, {tmp_path / "row.json": ROW}, dataset=toy_dataset.path, check=False, workers=2)
    assert last.state == "made" and rows_of(Result.load(last.path)) == rows_of(made)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["row.json"]


def test_the_words_of_a_shard_and_the_files_of_schedulers(vsfsim, tmp_path):
    task = "fewshot-shoes-v3-mini-v1"
    out = vsfsim("cluster", "--on", "k8s", "--shards=5", "evaluate", "--method", "cnp", "--task", task, cwd=tmp_path)
    words = '"vsfsim", "cluster", "--shard", "auto/5", "evaluate", "--method", "cnp", "--task"'
    assert words in out.stdout and "completions: 5" in out.stdout
    for words, text in ((("--on", "ray", "--shard", "0/2"), "--shard and --on do not go together"),
                        (("--on", "rai"), "--on is 'rai'. Did you mean 'ray'")):
        out = vsfsim("cluster", *words, "evaluate", "--method", "gaussian", "--task", task, cwd=tmp_path)
        assert out.returncode == 2 and text in out.stderr, out.stderr
