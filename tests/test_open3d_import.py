"""Open3D is imported without Plotly and Dash, which come when one of its functions that need them is called."""

import subprocess
import sys

import pytest

_ASKED = """
import sys
import grindvision.cell
import open3d
print("dash" in sys.modules, "plotly" in sys.modules)
cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector([[0.0, 0, 0], [1, 0, 0], [0, 2, 0]]))
for figure in (open3d.visualization.get_plotly_fig([cloud]), open3d.visualization.get_plotly_fig([cloud])):
    print(type(figure).__module__, len(figure.data[0]["x"]))
print(open3d.visualization.draw_plotly.__module__)
"""


def test_plotly_comes_when_open3d_draws_with_it_and_not_before():
    pytest.importorskip("open3d", reason="needs the extra sim")
    ran = subprocess.run([sys.executable, "-c", _ASKED], capture_output=True, text=True, timeout=120)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.split("\n")[:4] == [
        "False False",
        "plotly.graph_objs._figure 3",
        "plotly.graph_objs._figure 3",
        "open3d.visualization.draw_plotly",
    ]
