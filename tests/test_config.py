"""The configuration refuses what it does not know, and what it writes reads back the same."""

from pathlib import Path

import pytest
from pydantic import ValidationError

from fusion import config
from fusion_io.errors import UsageError


def _load(tmp_path: Path, text: str) -> config.RunConfig:
    path = tmp_path / "run.toml"
    path.write_text(text)
    return config.load(path, {})


def test_defaults_are_the_devkits_lengths_and_both_back_ends() -> None:
    resolved = config.load(None, {})
    assert resolved.segment_lengths_m == (100, 200, 300, 400, 500, 600, 700, 800)
    assert resolved.backend == "both"
    assert resolved.frontend.mode == "auto"


def test_the_resolved_configuration_reads_back_equal(tmp_path: Path) -> None:
    overrides = {
        "backend": "ekf",
        "segment_lengths_m": [10.0, 20.0],
        "topics": {"imu": "/imu/data"},
        "imu": {"rotation_imu_camera_quat_wxyz": [0.5, -0.5, 0.5, -0.5], "time_offset_s": 0.065},
        "frontend": {"mode": "violearner", "weights": "net.pt"},
    }
    resolved = config.load(None, overrides)
    assert _load(tmp_path, config.to_toml(resolved)) == resolved


def test_the_command_line_wins_over_the_file_and_keeps_the_rest_of_a_table(tmp_path: Path) -> None:
    path = tmp_path / "run.toml"
    path.write_text('backend = "ekf"\nrecord = "all"\n[frontend]\nmode = "recorded"\nweights = "a.pt"\n')
    resolved = config.load(path, {"backend": "posegraph", "frontend": {"weights": "b.pt"}})
    assert (resolved.backend, resolved.record) == ("posegraph", "all")
    assert (resolved.frontend.mode, resolved.frontend.weights) == ("recorded", Path("b.pt"))


def test_a_configuration_cannot_be_changed_after_it_is_loaded() -> None:
    with pytest.raises(ValidationError):
        config.load(None, {}).backend = "ekf"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('bakend = "ekf"', ["unknown name 'bakend'", "'backend'"]),
        ("[imu]\ntime_ofset = 0.1", ["unknown name 'imu.time_ofset'", "'imu.time_offset_s'"]),
        ('[topics]\nimage_topic = "/a"', ["unknown name 'topics.image_topic'", "'topics.image'"]),
        ('backend = "isam"', ["backend", "'posegraph', 'ekf' or 'both'", "'isam'"]),
        ("segment_lengths_m = []", ["segment_lengths_m"]),
        ("segment_lengths_m = [10.0, -5.0]", ["segment_lengths_m.1", "-5.0"]),
        ("imu = 3", ["imu", "3"]),
        ("[imu]\nrotation_imu_camera_quat_wxyz = [0.0, 0.0, 0.0, 0.0]", ["unit quaternion"]),
        ("[imu]\ntime_offset_s = nan", ["imu.time_offset_s", "finite"]),
        ("backend = ", ["not TOML"]),
    ],
)
def test_what_is_wrong_is_said_in_one_line_with_file_and_name(tmp_path: Path, text: str, words: list[str]) -> None:
    with pytest.raises(UsageError) as caught:
        _load(tmp_path, text)
    message = str(caught.value)
    assert "\n" not in message
    for word in ["run.toml", *words]:
        assert word in message


def test_a_missing_file_is_a_usage_error(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="No such file"):
        config.load(tmp_path / "none.toml", {})


def test_every_setting_of_the_back_ends_has_a_default() -> None:
    assert config.PoseGraphConfig() == config.RunConfig().posegraph
    assert config.EkfConfig() == config.RunConfig().ekf
