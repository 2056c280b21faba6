"""Several trainings: only the unfinished ones run, each with its arguments, and interrupted ones resume."""

from training import jobs
from training.jobs import Job
from training.resume import CHECKPOINT


def test_only_unfinished_trainings_run(tmp_path, monkeypatch):
    trained = []
    monkeypatch.setattr(jobs, "train", trained.append)
    folders = [tmp_path / name for name in "abc"]
    folders[1].mkdir()
    (folders[1] / "result.json").write_text("{}")
    jobs.train_all([Job("module", {}, folder) for folder in folders], 1)
    assert [job.folder for job in trained] == [folders[0], folders[2]]


def test_a_training_gets_its_arguments_and_resumes_from_a_checkpoint(tmp_path, monkeypatch):
    commands = []
    monkeypatch.setattr(jobs.subprocess, "run", lambda command, **rest: commands.append(" ".join(command)))
    job = Job("training.nav", {"--seed": 1, "--robot": None}, tmp_path / "run")
    jobs.train(job)
    (tmp_path / "run" / CHECKPOINT).touch()
    jobs.train(job)
    first, second = commands
    assert first.endswith(f"-m training.nav --out {tmp_path / 'run'} --seed 1")
    assert second == first + " --resume"
