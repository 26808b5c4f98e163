"""``python -m grindvision_book.exercises``: make the student copies, and the teacher's list of mistakes, anew."""

import sys

from grindvision.errors import GrindvisionError
from grindvision_book.exercises.guide import write_guide
from grindvision_book.exercises.student_copies import write_student_copies

try:
    copies = write_student_copies()
    written = [*copies, write_guide(path.name[:2] for path in copies)]
except GrindvisionError as error:
    sys.exit(f"exercises: {error}")
print(*written, sep="\n")
