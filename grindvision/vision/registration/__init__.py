"""Two scans in, the pose between them out.

Data flow: two scans -> ``global_registration`` proposes poses (``sac_ia`` is the first paper's own way) ->
``plane_icp`` (``icp`` point to point and generalised) -> ``verification`` chooses among ``pose_candidates`` and their
``rivals`` by ``evidence`` from both scanners' ``depth_image``, and names ``free_motions``; ``deformable`` takes up a
smooth bending that is left. A pair that no rigid pose fits goes through ``deformed_registration``: ``deformation_fit``
fits a field, ``deformation``, beside the pose.
"""
