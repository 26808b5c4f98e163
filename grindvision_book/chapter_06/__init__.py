"""What chapter 06 computes: nearest-neighbour searches side by side, and the path of the paper's boxes."""
