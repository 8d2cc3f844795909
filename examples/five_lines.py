"""What the command does, in five lines of Python: ``python examples/five_lines.py samples/kitti06.mcap``."""

import sys

import fusion
import fusion_io
import learned

log = fusion_io.open_log(sys.argv[1])
pairs = log.pairs() or learned.estimate_pairs(log)
trajectory = fusion.fuse(pairs, log.imu(), backend="ekf")
metrics = fusion.evaluate(trajectory, log.ground_truth())
print(f"{log.path.name}: {trajectory.path_length_m:.1f} m, {metrics}")
