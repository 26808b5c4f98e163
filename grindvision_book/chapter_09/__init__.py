"""What chapter 09 computes: found paths under many conditions, and what a wheel leaves of the bead they follow."""
