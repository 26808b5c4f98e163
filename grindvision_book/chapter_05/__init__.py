"""What chapter 05 computes: what an instrument shows without noise, and where registration succeeds."""
