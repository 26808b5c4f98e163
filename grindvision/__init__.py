"""Robot vision for grinding and welding: the package behind the reproducible experiment book.

Rooms, in the order data flows through them: ``geometry``, ``arm``, ``paper``, ``cell``, ``vision``,
``calibration``, ``motion``, ``book``. Import the room you need: ``from grindvision import vision``.
"""

import os

from grindvision.kernel_caches import drop_stale_caches

# Our arrays are long and thin: threads of the linear algebra library cost more than they bring, and spin beside ours.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

drop_stale_caches()

__version__ = "0.1.0"
