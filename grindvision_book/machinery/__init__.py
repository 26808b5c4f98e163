"""What runs the book: places, sessions, figures, answers, builds, and what is kept and published of them."""
