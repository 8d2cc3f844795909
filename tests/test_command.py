"""What the commands have in common: errors are one line and an exit code, and `-` is a pipe."""

import argparse
import json
from pathlib import Path

import pytest

from fusion_io.command import STANDARD_OUTPUT, answered, called_as, command_parser, role_and_topic, write_json
from fusion_io.errors import LogError, UsageError


@pytest.mark.parametrize(
    ("raised", "code", "line"),
    [
        (LogError("a.mcap: not a log"), 1, "error: a.mcap: not a log"),
        (UsageError("no such option"), 2, "error: no such option"),
        (KeyboardInterrupt(), 130, "interrupted: nothing was written"),
        (KeyboardInterrupt("step 7"), 130, "step 7: nothing was written"),
    ],
)
def test_an_expected_error_is_a_line_and_a_code(
    raised: BaseException, code: int, line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    def job() -> int:
        raise raised

    assert answered(job, ": nothing was written") == code
    assert capsys.readouterr() == ("", f"{line}\n")


def test_a_job_that_ends_by_itself_gives_its_own_code_and_a_bug_its_traceback() -> None:
    assert answered(lambda: 3) == 3
    with pytest.raises(ZeroDivisionError):
        answered(lambda: 1 // 0)


def test_json_goes_to_a_file_with_its_folders_or_to_the_pipe(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "new" / "a.json"
    write_json(path, {"a": 1})
    write_json(STANDARD_OUTPUT, {"a": 1})
    assert json.loads(path.read_text()) == {"a": 1}
    assert capsys.readouterr().out == path.read_text()
    with pytest.raises(LogError, match=r"a\.json: cannot be written"):
        write_json(path / "a.json", {})
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(path, {"a": float("nan")})


@pytest.mark.parametrize("text", ["imu", "=/imu", "imu="])
def test_a_role_needs_a_topic(text: str) -> None:
    assert role_and_topic("imu=/a=b") == ("imu", "/a=b")
    with pytest.raises(argparse.ArgumentTypeError, match="ROLE=NAME"):
        role_and_topic(text)


def test_a_command_is_called_in_its_help_as_it_was_called() -> None:
    """By its module, or by the name that stands for it meanwhile; the rest of an example stays."""

    def shown() -> str:
        return command_parser("fusion.run", "What it does.", "examples:\n  python -m fusion.run --log a").format_help()

    assert shown().startswith("usage: python -m fusion.run ")
    with called_as("violearner run"):
        named = shown()
    assert named.startswith("usage: violearner run ")
    assert "examples:\n  violearner run --log a" in named
    assert shown().startswith("usage: python -m fusion.run ")
