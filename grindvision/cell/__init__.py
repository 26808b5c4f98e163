"""The virtual cell: arms, scanners and workpieces that make scans and measurements with ground truth."""
