"""What chapter 13 computes: the methods of the other chapters on data that others measured, and what judges them.

``here`` says which sets are on this machine; ``arms``, ``sphere``, ``views``, ``scans`` and ``twin`` hold the methods,
``drawings`` the figures.
"""

from grindvision_book.chapter_13.here import Sets, judged_rows, sets_here

__all__ = ["Sets", "judged_rows", "sets_here"]
