"""Robot vision for grinding and welding: the package behind the reproducible experiment book.

Rooms, in the order data flows through them: ``geometry``, ``arm``, ``paper``, ``cell``, ``vision``,
``calibration``, ``motion``, ``book``. Import the room you need: ``from grindvision import vision``.
"""

__version__ = "0.1.0"
