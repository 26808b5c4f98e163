"""A cloud in, weld seams and the way points along them out.

Data flow: ``viewing_frames`` -> ``height_field`` -> ``valley`` (closed and subtracted) -> ``groove_profile``,
``groove_lines``, ``groove_fit`` -> ``groove`` finds grooves. ``surface_pairs`` -> ``seam_tracing`` -> ``face_fit``,
``joint_fit`` and ``step_fit`` (for gaps ``gap_lines`` -> ``step_fit``) -> ``face_shapes``, ``seam_kinds`` find and name
other joints, in ``surface_seams``. ``point_density`` tells where the camera stood, ``seam_sight`` what of
a seam it saw. ``seams`` puts both together, ``seam_path`` puts way points along them. ``mls``,
``gfh``, ``gfh_groove`` are the second paper's own way; ``weld`` runs either.
"""
