"""What chapter 11 computes and draws: way points, their errors, the torch, and the robot that follows."""
