"""The virtual cell: arms, scanners and workpieces that make scans with ground truth."""
