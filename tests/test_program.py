"""The commands as programs: correct exit codes, whatever happens to the streams and to the parent."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from itertools import product
from pathlib import Path

from ceres_cal.cli.command import COMMANDS

ROOT = Path(__file__).resolve().parents[1]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
PROGRAM = "import sys; from ceres_cal.cli import main; sys.exit(main())"
STREAMS = ("open", "closed", "full", "broken")

# Forks itself for each call after a first one, since starting and importing takes longer than the call.
FORKING = """
import contextlib, io, json, os, sys
from ceres_cal.cli import main

def put(number, kind):
    if kind == "closed":  # as Python finds it at its start
        os.close(number)
        setattr(sys, ("", "stdout", "stderr")[number], None)
        return
    reading, writing = os.pipe()
    os.close(reading)
    end = writing if kind == "broken" else os.open({"open": "/dev/null", "full": "/dev/full"}[kind], os.O_WRONLY)
    os.dup2(end, number)

codes, before = [], None
for arguments, kinds in json.loads(sys.argv[1]):
    if arguments != before:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            main(arguments)
        before = arguments
    child = os.fork()
    if not child:
        for number, kind in enumerate(kinds, start=1):
            put(number, kind)
        sys.argv = ["ceres-cal", *arguments]
        os._exit(main())
    codes.append(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
print(json.dumps(codes))
"""


def codes_of(calls: list[tuple[list[str], tuple[str, ...]]]) -> list[int]:
    words = [sys.executable, "-c", FORKING, json.dumps(calls)]
    run = subprocess.run(words, env=ENVIRONMENT, capture_output=True, text=True, timeout=120, check=True)
    codes: list[int] = json.loads(run.stdout)
    return codes


def test_streams_do_not_change_an_exit_code() -> None:
    """Scripts refit if `check` exits with 1, so a failure without a readable message must stay a failure."""
    wanted = {
        ("check", "/nonexistent", "/nonexistent"): 2,
        ("check", "/nonexistent", "/nonexistent", "--json"): 2,
        ("targets", "ssl-a"): 0,
        ("targets", "ssl-a", "--json"): 0,
        ("--help",): 0,
        (): 2,
    }
    calls = [(list(arguments), kinds) for arguments in wanted for kinds in product(STREAMS, repeat=2)]
    codes = dict(zip([(tuple(arguments), kinds) for arguments, kinds in calls], codes_of(calls), strict=True))
    assert {call: code for call, code in codes.items() if code != wanted[call[0]]} == {}


def test_every_command_fails_as_one_where_nothing_can_be_said() -> None:
    kinds: list[tuple[str, ...]] = [("closed", "closed"), ("open", "closed"), ("full", "full"), ("broken", "broken")]
    calls = [([*name.split(), "--bogus"], both) for name in COMMANDS for both in kinds]
    codes = zip(calls, codes_of(calls), strict=True)
    assert [call for call, code in codes if code != 2] == []


def test_a_camera_that_moved_is_1(files_of_a_move: Path) -> None:
    script = f'"$0" -c "{PROGRAM}" check old.json after.json >/dev/full 2>&-'
    run = subprocess.run(["bash", "-c", script, sys.executable], cwd=files_of_a_move, env=ENVIRONMENT, check=False)
    assert run.returncode == 1


def test_what_is_opened_next_is_no_standard_stream(tmp_path: Path) -> None:
    """If descriptor 2 is free, a file opened for output would get the libraries' messages."""
    program = (
        "import os; from ceres_cal.cli.terminal import as_a_program; as_a_program()\n"
        "number = os.open('file', os.O_WRONLY | os.O_CREAT); assert number > 2, number\n"
        "os.write(1, b'noise'); os.write(2, b'noise'); os.write(number, b'ours')"
    )
    script = f'"$0" -c "{program}" <&- >&- 2>&-'
    run = subprocess.run(["bash", "-c", script, sys.executable], cwd=tmp_path, env=ENVIRONMENT, check=False)
    assert (run.returncode, (tmp_path / "file").read_bytes()) == (0, b"ours")


def test_a_lost_answer_is_said() -> None:
    with Path("/dev/full").open("w") as full:
        words = [sys.executable, "-c", PROGRAM, "targets", "ssl-a"]
        run = subprocess.run(words, env=ENVIRONMENT, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert run.stderr == "ceres-cal: the answer is not on standard output: No space left on device\n"


def test_a_pipe_that_does_not_block_gets_all() -> None:
    """Like the pipes of Node.js: the whole answer arrives, although the pipe holds only a part at a time."""
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    words = [sys.executable, "-c", PROGRAM, "targets", "ssl-a", "--json"]
    with subprocess.Popen(words, env=ENVIRONMENT, stdout=writing) as process:
        os.close(writing)
        with open(reading) as stream:  # noqa: PTH123 a descriptor
            assert json.loads(stream.read())
    assert process.returncode == 0


WORKING = """
import os, sys, time
from pathlib import Path
from ceres_cal.base.executing import processes

def work(folder):
    Path(folder, str(os.getpid())).touch()
    time.sleep(60.0)

if __name__ == "__main__":
    with processes(2) as pool:
        list(pool.map(work, sys.argv[1:] * 2))
"""


def test_processes_end_with_a_parent_that_is_killed(tmp_path: Path) -> None:
    """During their work; those of `batch --jobs` and all others are made by `base.executing`."""
    (tmp_path / "working.py").write_text(WORKING)
    (pids := tmp_path / "pids").mkdir()
    process = subprocess.Popen([sys.executable, str(tmp_path / "working.py"), str(pids)], env=ENVIRONMENT)
    until(lambda: len(list(pids.iterdir())) == 2)
    process.kill()
    process.wait()
    until(lambda: not any(runs(one.name) for one in pids.iterdir()))


def runs(pid: str) -> bool:
    """Whether a process runs: it is neither gone nor a zombie."""
    try:
        return bool(Path("/proc", pid, "cmdline").read_bytes())
    except OSError:
        return False


def until(holds: Callable[[], bool]) -> None:
    ends = time.monotonic() + 20.0
    while not holds():
        assert time.monotonic() < ends
        time.sleep(0.02)


def test_the_package_is_a_program() -> None:
    asked = [sys.executable, "-m", "ceres_cal", "tragets"]
    done = subprocess.run(asked, capture_output=True, text=True, env=ENVIRONMENT, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.strip() == "ceres-cal: there is no command 'tragets': did you mean 'targets'?"
