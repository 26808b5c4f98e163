"""What one scan says about its surface: voxel grid, normals, surfels, descriptors, distances to it.

Data flow: cloud -> ``voxel_grid``, ``surfels`` (with ``normals``) -> ``keypoints``, ``fpfh`` -> ``scan``, which holds
all of it; ``signed_distance`` of points above a surface, ``clustering`` of points into pieces.
"""
