"""What chapter 14 computes: a camera on an arm whose place is planted, and what finds it without a tracker.

``simulated`` holds the scene, ``compared`` the studies, ``joined`` the views of a part, ``others`` the measured views,
``drawings`` the figures.
"""
