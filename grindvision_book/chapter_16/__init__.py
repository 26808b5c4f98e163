"""Chapter 16: a bead of the twin ground away in simulation, from the first pass to the proof."""
