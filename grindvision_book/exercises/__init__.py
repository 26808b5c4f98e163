"""The exercises: what is asked, which mistakes are known, the checker, and the student copies of the notebooks."""
