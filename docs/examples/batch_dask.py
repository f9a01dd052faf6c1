"""Dask cluster: reconstruct the scans of a session on one, with `pip install 'slviewer[batch]'`.

Here the cluster is a process of this machine; `scheduler="tcp://host:8786"` names another one.
"""

import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

import slviewer as sl


def main() -> None:
    """Simulate a session, calibrate it, and reconstruct its planes in parallel."""
    session = Path(tempfile.mkdtemp()) / "session"
    sl.simulate(session, scale=0.15, poses=6)
    sl.calibrate(session, "circles:21x16:9", models=["stereo"])
    done = sl.batch([session], "verify", captures=["plane_*"], shape="plane")
    print(done.text())
    assert not done.failed

    rms = {each.capture: each.figures["stereo RMS mm"] for each in done.done}
    figure, axis = plt.subplots(figsize=(6, 3), layout="constrained")
    axis.bar(list(rms), [1000 * value for value in rms.values()])
    axis.set(ylabel="RMS from a plane, µm", title="Ten planes, stereo model")
    axis.tick_params(axis="x", rotation=45)
    figure.savefig(sys.argv[1], dpi=100)


if __name__ == "__main__":  # the workers of the cluster import this file
    main()
