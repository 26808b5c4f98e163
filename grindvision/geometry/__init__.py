"""Pure functions on arrays: rigid transforms, rigid, plane and sphere fits. Imports no other room."""

from grindvision.geometry.fits import (
    PlaneFit,
    RigidFit,
    SphereFit,
    check_points,
    fit_plane,
    fit_rigid,
    fit_sphere,
)
from grindvision.geometry.transforms import (
    angle_between,
    check_rigid,
    inverse,
    mean_rigid,
    motion_columns,
    move_points,
    nearest_rotation,
    orthonormalised,
    random_rotation,
    rigid,
    rotate_vectors,
    rotation_about,
    rotation_axis,
    skew,
    small_motion,
    twist_between,
    unit_vectors,
    vector_angle,
)
from grindvision.lazy import lazy_names

_, __getattr__ = lazy_names(__name__, {}, {"turn_vectors": "rotate_vectors"})

__all__ = [
    "PlaneFit",
    "RigidFit",
    "SphereFit",
    "angle_between",
    "check_points",
    "check_rigid",
    "fit_plane",
    "fit_rigid",
    "fit_sphere",
    "inverse",
    "mean_rigid",
    "motion_columns",
    "move_points",
    "nearest_rotation",
    "orthonormalised",
    "random_rotation",
    "rigid",
    "rotate_vectors",
    "rotation_about",
    "rotation_axis",
    "skew",
    "small_motion",
    "twist_between",
    "unit_vectors",
    "vector_angle",
]
