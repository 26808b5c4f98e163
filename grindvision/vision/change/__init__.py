"""A registered pair in, what stands above the good surface and its path points out.

Data flow: ``visibility`` (what the good scan shows) -> ``change_detection`` -> ``centreline`` of a piece ->
``ridge_path`` (``oriented_box`` is the first paper's own way); ``detection`` runs it from the two scans on,
``diagnostics`` names what in the inputs puts the result in doubt. ``stock`` (on ``height_maps``, ``local_datum``,
``stock_sums``) lays the pieces out over the good surface: heights, volumes and areas with their uncertainty.
"""
