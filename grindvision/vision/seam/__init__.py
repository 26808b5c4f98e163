"""A cloud in, grooves and the way points of their seams out.

Data flow: ``viewing_frames`` -> ``height_field`` -> ``valley`` (closed and subtracted) -> ``groove_profile``,
``groove_lines``, ``groove_fit`` -> ``groove`` -> ``seam_path``; ``mls``, ``gfh``, ``gfh_groove`` are the second
paper's own way; ``weld`` runs either.
"""
