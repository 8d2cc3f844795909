"""From Python: the same numbers as the command, with no import that is not needed."""

import json
import subprocess
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from log_samples import write_sample
from test_interop import drive

import fusion
import fusion_io
import learned
from fusion import run
from fusion.config import RunConfig
from fusion_io.records import PairEstimate
from fusion_io.writer import LogWriter

ROOT = Path(__file__).resolve().parents[1]
SAMPLE = ROOT / "samples" / "kitti06.mcap"


@pytest.fixture(scope="module")
def log_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log with pairs, IMU and ground truth."""
    path = tmp_path_factory.mktemp("api") / "in.mcap"
    truth, pairs, imu = drive()
    with LogWriter(path) as log:
        log.imu(imu)
        log.ground_truth(truth)
        log.pairs(pairs)
    return path


@pytest.fixture
def evaluated(log_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], dict[str, object]]:
    """evaluated(name): what the command writes of a trajectory to metrics.json."""
    for pictures in ("write_plots", "write_report"):
        monkeypatch.setattr(f"fusion.output.{pictures}", lambda *_: None)

    def make(name: str) -> dict[str, object]:
        assert run.run(log_path, tmp_path / "out", RunConfig(), run.Presentation(quiet=True)) == 0
        document = json.loads((tmp_path / "out" / "metrics.json").read_text())
        found: dict[str, object] = document["trajectories"][name]
        return found

    return make


@pytest.mark.parametrize("backend", ["raw", "posegraph", "ekf"])
def test_python_gives_the_numbers_of_the_command(
    backend: str, log_path: Path, evaluated: Callable[[str], dict[str, object]]
) -> None:
    """To the last bit: five lines do what the command does."""
    log = fusion_io.open_log(log_path)
    trajectory = fusion.fuse(log.pairs(), log.imu(), backend=backend)  # type: ignore[arg-type]  # a parameter here
    metrics = fusion.evaluate(trajectory, log.ground_truth())
    expected = evaluated(backend)
    assert {name: getattr(metrics, name) for name in fusion.Metrics.__slots__} == {
        name: value for name, value in expected.items() if not name.startswith("nis")
    }


def test_pairs_alone_are_fused_without_an_imu(log_path: Path) -> None:
    pairs = fusion_io.open_log(log_path).pairs()
    trajectory = fusion.fuse(pairs)
    raw = fusion.fuse(pairs, backend="raw")
    assert len(trajectory) == len(pairs) + 1
    np.testing.assert_allclose(trajectory.poses.translation, raw.poses.translation, atol=1e-6)


def test_frames_that_no_pair_leads_through_are_bridged_where_they_are_named(log_path: Path) -> None:
    pairs = fusion_io.open_log(log_path).pairs()
    stamps = np.array([pairs[0].source_stamp_ns, *(pair.target_stamp_ns for pair in pairs)])
    with_hole = [pair for i, pair in enumerate(pairs) if i not in {10, 11}]
    assert len(fusion.fuse(with_hole, backend="raw")) == len(stamps) - 1
    assert len(fusion.fuse(with_hole, backend="raw", frame_stamps=stamps)) == len(stamps)


def test_no_pairs_is_an_error_in_a_line() -> None:
    with pytest.raises(fusion_io.FusionError, match="no pair estimates"):
        fusion.fuse([])


def test_pair_estimates_are_those_of_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Passed through their message, in order, with the options handed on."""
    log = fusion_io.open_log(write_sample(tmp_path / "log.mcap"))
    seen: list[object] = []
    expected = log.pairs()

    def recorded(*arguments: object, refined: bool) -> list[PairEstimate]:
        seen.extend([arguments[2], refined])
        return expected

    monkeypatch.setattr("learned.estimator.estimate_pairs", recorded)
    estimated = learned.estimate_pairs(log, "some.pt", refine=False)
    assert seen == [Path("some.pt"), False]
    assert [pair.covariance.tobytes() for pair in estimated] == [pair.covariance.tobytes() for pair in expected]


# --- Imports ------------------------------------------------------------------------------------


@pytest.mark.parametrize("package", ["fusion", "learned", "fusion_io"])
def test_a_package_imports_nothing_heavy_until_it_is_asked(package: str) -> None:
    script = f"import sys, {package}; sys.exit(str({{'numpy', 'torch', 'gtsam', 'scipy'}} & set(sys.modules) or ''))"
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert result.stderr.strip() == ""


@pytest.mark.parametrize("package", [fusion, learned, fusion_io])
def test_every_public_name_is_there_and_says_what_it_is(package: object) -> None:
    for name in package.__all__:  # type: ignore[attr-defined]
        assert getattr(package, name).__doc__
    with pytest.raises(AttributeError, match="has no attribute 'nonsense'"):
        getattr(package, "nonsense")  # noqa: B009


# --- Examples -----------------------------------------------------------------------------------


@pytest.fixture
def fast_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """The pairs of the sample by an untrained guess: the network has its own tests and takes its time."""

    def guessed(log: fusion_io.Log, weights: None = None) -> list[PairEstimate]:
        stamps = log.frame_stamps().tolist()
        forward, covariance = np.array([0.0, 0.0, 1.2]), np.diag([1e-4] * 3 + [1e-2] * 3)
        identity = np.array([1.0, 0.0, 0.0, 0.0])
        return [PairEstimate(a, b, identity, forward, covariance) for a, b in pairwise(stamps)]

    monkeypatch.setattr(learned, "estimate_pairs", guessed, raising=False)


def test_the_five_lines_run(log_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, ROOT / "examples" / "five_lines.py", log_path], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "ate_m=" in done.stdout
    code = (ROOT / "examples" / "five_lines.py").read_text().split("import learned\n")[1]
    assert len([line for line in code.splitlines() if line]) == 5


@pytest.mark.usefixtures("fast_network")
def test_the_notebook_runs_from_top_to_bottom(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its cells, one after the other in one namespace, as a kernel runs them; it is stored without outputs."""
    monkeypatch.chdir(ROOT)
    mpl.use("agg")
    cells = json.loads((ROOT / "examples" / "notebook.ipynb").read_text())["cells"]
    namespace: dict[str, object] = {}
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert len(code) >= 5
    for cell in code:
        assert cell["outputs"] == []
        exec(compile("".join(cell["source"]), "notebook.ipynb", "exec"), namespace)
    assert set(namespace["trajectories"]) == {"raw", "posegraph", "ekf"}  # type: ignore[call-overload]
