"""``python -m grindvision.book.exercises``: make the student copies anew from the masters."""

import sys

from grindvision.book.exercises.student_copies import write_student_copies
from grindvision.errors import GrindvisionError

try:
    for path in write_student_copies():
        print(path)
except GrindvisionError as error:
    sys.exit(f"exercises: {error}")
