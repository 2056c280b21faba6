"""Several trainings: only the unfinished ones run, each with its arguments, and interrupted ones resume."""

from training import jobs
from training.jobs import Job
from training.resume import CHECKPOINT


def test_only_unfinished_trainings_run(tmp_path):
    trained = []
    folders = [tmp_path / name for name in "abc"]
    folders[1].mkdir()
    (folders[1] / "result.json").write_text("{}")
    jobs.train_all([Job("module", {}, folder) for folder in folders], 1, trained.append)
    assert [job.folder for job in trained] == [folders[0], folders[2]]


def test_a_training_gets_its_arguments_and_resumes_from_a_checkpoint(tmp_path):
    job = Job("training.nav", {"--seed": 1, "--robot": None}, tmp_path / "run")
    first = " ".join(jobs.command_of(job))
    job.folder.mkdir()
    (job.folder / CHECKPOINT).touch()
    second = " ".join(jobs.command_of(job))
    assert first.endswith(f"-m training.nav --out {tmp_path / 'run'} --seed 1")
    assert second == first + " --resume"
