"""Robot vision for grinding and welding: the package behind the reproducible experiment book.

Rooms, in the order data flows through them: ``geometry``, ``arm``, ``paper``, ``cell``, ``vision``,
``calibration``, ``motion``, ``book``. Import the room you need: ``from grindvision import vision``.
"""

import os

# Our arrays are long and thin: threads of the linear algebra library cost more than they bring, and spin beside ours.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

__version__ = "0.1.0"
