"""What chapter 08 computes and draws: paths found from several orientations of many robot cells."""
