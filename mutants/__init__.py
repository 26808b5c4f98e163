"""Mutation testing: small faults are put into a copy of the code, one at a time, and the tests have to notice.

``chosen.csv`` lists faults that once went unnoticed; every one of them must be noticed now. The rest
are drawn at random.
"""
