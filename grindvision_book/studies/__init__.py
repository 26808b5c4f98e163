"""Studies: one function of parameters and a random generator over many cases, here or on a cluster."""
