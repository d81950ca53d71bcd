"""Many jobs: one line each, stored, resumed, ranked; a failed one does not stop others, Ctrl-C keeps finished ones."""

import json
import os
import pickle
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest

from ceres_cal import Options, advise, calibrate
from ceres_cal.base.errors import InputError
from ceres_cal.base.executing import each, processes
from ceres_cal.base.threads import available
from ceres_cal.base.words import ROBOT_TOP_M
from ceres_cal.cli import main
from ceres_cal.cli.batch import _of_calibration
from ceres_cal.cli.files import finishing
from ceres_cal.cli.jobs import RESULTS, Job, Outcome, read_plan, remember, remembered, run_jobs
from ceres_cal.diagnostics.advice.ranking import _prepared
from ceres_cal.observations import Observations
from ceres_cal.simulate import built_in_scene, simulate

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A plan with a good camera, an unreadable file, a camera that moved, and a missing file."""
    folder = tmp_path_factory.mktemp("hall")
    observations = Observations.load(ROOT / "data" / "ssl_field" / "observations.json")
    observations.save(folder / "north.json")
    (folder / "broken.json").write_text("{")
    shutil.copy(ROOT / "data" / "ssl_field_moved" / "observations.json", folder / "moved.json")
    assert main(["calibrate", str(folder / "north.json"), "--lens", "radial", "-o", str(folder / "before.json")]) == 0
    (folder / "plan.toml").write_text(
        """
        [[job]]
        name = "north"
        command = "calibrate"
        arguments = ["north.json", "--lens", "radial"]
        [[job]]
        name = "broken"
        command = "calibrate"
        arguments = "broken.json"
        [[job]]
        name = "moved"
        command = "check"
        arguments = "before.json moved.json"
        [[job]]
        name = "gone"
        command = "refit"
        arguments = "before.json gone.json"
        """
    )
    return folder


def lines_of(text: str) -> dict[str, str]:
    """The line of each job."""
    parts = [line.split("  ") for line in text.splitlines() if " of 4  " in line]
    return {part[-1].partition(":")[0]: part[0].strip() for part in parts}


def test_each_job_is_a_line_and_what_is_done_is_not_done_again(
    hall: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    to = tmp_path / "results"
    assert main(["batch", str(hall / "plan.toml"), "-o", str(to), "--jobs", "1"]) == 3
    said = capsys.readouterr()
    assert said.err == ""
    levels = {"north": "good", "broken": "failed", "moved": "no", "gone": "failed"}
    assert lines_of(said.out) == levels
    assert "4 jobs: 1 good, 1 no, 2 failed\n" in said.out
    page = (to / "summary.html").read_text(encoding="utf-8")
    cards = [page.index(f">{name}: ") for name in ("broken", "gone", "moved")]
    assert cards == sorted(cards) and ">3 jobs of 4 to look at.<" in page and ">north: " not in page
    made = (to / "north.json").stat().st_mtime_ns
    assert main(["batch", str(hall / "plan.toml"), "-o", str(to), "--jobs", "1", "--json"]) == 3
    answer = json.loads(capsys.readouterr().out)
    assert answer["from_before"] == 2  # what failed is tried again
    assert {one["job"]: one["level"] for one in answer["jobs"]} == levels
    assert [one["level"] for one in answer["jobs"]] == ["failed", "failed", "no", "good"]
    assert (to / "north.json").stat().st_mtime_ns == made


def job(folder: Path, name: str, *arguments: str) -> Job:
    """Squares the numbers in a file."""
    (folder / name).write_text("1 2 3")
    return Job(name, "square", arguments, (folder / name,), (folder / f"{name}.out",))


def squared(job: Job) -> Outcome:
    if "fail" in job.arguments:
        raise ValueError("no\nnumbers")
    if "die" in job.arguments:
        os._exit(9)
    total = sum(int(part) ** 2 for part in job.inputs[0].read_text().split())
    job.outputs[0].write_text(str(total))
    return Outcome(job.name, job.command, "good", str(total), worst_mm=float(total))


def test_a_job_is_done_again_where_something_changed(tmp_path: Path) -> None:
    jobs = [job(tmp_path, name) for name in ("a", "b", "c", "d")]
    assert [old for _, old in run_jobs(jobs, squared, tmp_path)] == [False] * 4
    jobs[0].inputs[0].write_text("1 2")
    jobs[1].outputs[0].unlink()
    jobs[2] = replace(jobs[2], arguments=("--more",))
    done = {one.job: (one.line, old) for one, old in run_jobs(jobs, squared, tmp_path)}
    assert done == {"a": ("5", False), "b": ("14", False), "c": ("14", False), "d": ("14", True)}


def test_a_result_that_was_cut_short_is_none(tmp_path: Path) -> None:
    for name in ("a", "b"):
        remember(Outcome(name, "square", "good", "1"), tmp_path)
    with (tmp_path / RESULTS).open("rb+") as stream:
        stream.truncate((tmp_path / RESULTS).stat().st_size - 5)
    assert set(remembered(tmp_path)) == {"a"}
    (tmp_path / RESULTS).write_text("junk\n")
    with pytest.raises(InputError, match="line 1: no result of a job"):
        remembered(tmp_path)


@pytest.mark.parametrize("kind", ["none", "threads", "processes"])
def test_a_failed_job_stops_nobody_whatever_the_executor(tmp_path: Path, kind: str) -> None:
    jobs = [job(tmp_path, "a"), job(tmp_path, "b", "fail"), job(tmp_path, "c")]

    def levels(executor: Executor | None) -> dict[str, str]:
        return {one.job: f"{one.level} {one.line}" for one, _ in run_jobs(jobs, squared, tmp_path, executor)}

    expected = {"a": "good 14", "b": "failed unexpected ValueError: no numbers: please report it", "c": "good 14"}
    if kind == "none":
        assert levels(None) == expected
    elif kind == "threads":
        with ThreadPoolExecutor(2) as pool:
            assert levels(pool) == expected
    else:
        with processes(2) as executor:
            assert levels(executor) == expected
            assert list(each(cores, range(2), executor=executor)) == [max(available() // 2, 1)] * 2
            done = [one for one, _ in run_jobs([job(tmp_path, "x", "die")], squared, tmp_path, executor)]
            assert done[0].level == "failed" and done[0].line.startswith("its process ended")


def cores(_: int) -> int:
    return available()


PLANS = {
    "twice.csv": ("name,command,arguments\na,check,x y\na,check,x z\n", "2 jobs are called 'a'"),
    "more.csv": ("name,command,arguments\na,check,x,y\n", "line 2: more columns than heads"),
    "key.jsonl": ('{"name": "a", "command": "check", "lens": "auto"}\n', "there is no field 'lens'"),
    "path.jsonl": ('{"name": "../a", "command": "check"}\n', "files have its name"),
    "quote.jsonl": ('{"name": "a", "command": "check", "arguments": "\\"x"}\n', "No closing quotation"),
    "other.toml": ('[[job]]\nname = "a"\ncommand = "locate"\n', "there is no command 'locate' for a batch"),
    "usage.toml": ('[[job]]\nname = "a"\ncommand = "check"\n', "job 'a': the following arguments are required"),
    "output.toml": ('[[job]]\nname = "a"\ncommand = "calibrate"\narguments = "x -o y"\n', "leave out"),
    "empty.csv": ("name,command,arguments\n", "it contains no job"),
    "plan.txt": ("", "a plan is a folder, or a table in .jsonl, .csv or .toml"),
}


@pytest.mark.parametrize("name", PLANS)
def test_a_wrong_plan_is_said_before_any_work(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text, words = PLANS[name]
    (tmp_path / name).write_text(text)
    assert main(["batch", str(tmp_path / name), "-o", str(tmp_path / "to")]) == 2
    said = capsys.readouterr()
    assert words in said.err and said.err.count("\n") == 1 and said.out == ""
    assert not (tmp_path / "to").exists()


def test_a_folder_is_a_plan(hall: Path, tmp_path: Path) -> None:
    (tmp_path / "east").mkdir()
    for name in ("east/one.json", "east/two.json", "south.json"):
        shutil.copy(hall / "north.json", tmp_path / name)
    shutil.copy(hall / "before.json", tmp_path / "calibration.json")  # is none of observations
    assert [(row.name, row.arguments) for row in read_plan(tmp_path)] == [
        ("east", ("east/one.json", "east/two.json")),
        ("south", ("south.json",)),
    ]


def test_ctrl_c_leaves_what_is_done_and_no_process(tmp_path: Path) -> None:
    observations = simulate(*built_in_scene("boards"), seed=1).observations
    observations.save(tmp_path / "00.json")
    for number in range(1, 40):
        shutil.copy(tmp_path / "00.json", tmp_path / f"{number:02}.json")
    to = tmp_path / "to"
    code = "import sys\nfrom ceres_cal.cli import main\nif __name__ == '__main__': sys.exit(main())"
    command = [
        sys.executable,
        "-c",
        code,
        "batch",
        str(tmp_path),
        "-o",
        str(to),
        "--jobs",
        "2",
        "--options",
        "--lens radial",
    ]
    run = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)
    assert run.stdout is not None
    first = run.stdout.readline()
    os.killpg(run.pid, signal.SIGINT)  # as a terminal does: to all of them
    _, error = run.communicate(timeout=20)
    assert run.returncode == 130 and first.startswith("good"), (first, error)
    assert error.startswith("ceres-cal: interrupted: files written: ") and error.count("\n") == 1
    done = remembered(to)
    assert 0 < len(done) < 40 and all(one.level != "failed" for one in done.values())
    for _ in range(50):  # Python's resource tracker ends after all others
        left = subprocess.run(["ps", "-o", "stat=,args=", "-g", str(run.pid)], capture_output=True, text=True).stdout
        if not (alive := [line for line in left.splitlines() if not line.startswith("Z")]):
            break
        time.sleep(0.1)
    assert alive == []


def _writing(folder: Path) -> None:
    """A job that is interrupted while it writes, and would go on for long."""
    with finishing():
        (folder / "begun").touch()
        time.sleep(0.3)
    time.sleep(5.0)
    (folder / "ended").touch()


def test_what_is_interrupted_while_it_writes_ends(tmp_path: Path) -> None:
    def interrupted() -> None:
        with processes(2) as executor:
            assert executor is not None
            executor.submit(_writing, tmp_path)
            while not (tmp_path / "begun").exists():
                time.sleep(0.01)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert not (tmp_path / "ended").exists()


def test_one_process_is_none() -> None:
    with processes(1) as executor:
        assert executor is None
    with pytest.raises(InputError, match="-1 jobs at a time"), processes(-1):
        pass


@pytest.mark.thorough
def test_advice_is_the_same_over_an_executor() -> None:
    straight = calibrate(simulate(*built_in_scene("ssl-field"), seed=1).observations, Options(lens="radial"))
    promised = advise(straight)
    with ThreadPoolExecutor(2) as pool:
        same = advise(straight, executor=pool)
    assert [(one.measurement.words, vars(one.after)) for one in promised.promises] == [
        (one.measurement.words, vars(one.after)) for one in same.promises
    ]
    ground, outlook = _prepared(straight, None, ROBOT_TOP_M)  # what processes would be handed
    assert pickle.loads(pickle.dumps(ground.information_of)).__self__.keys == ground.keys and pickle.dumps(outlook)


def test_a_report_that_could_not_be_made_is_said() -> None:
    verdict = {"level": "good", "headline": "It can be trusted.", "reasons": []}
    data = {"verdict": verdict, "uncertainty": None, "not_made": {"report": "a.jpg: no image"}}
    outcome = _of_calibration(Job("a", "calibrate", ()), data)
    assert (outcome.level, outcome.reasons) == ("care", ("no report: a.jpg: no image",))
