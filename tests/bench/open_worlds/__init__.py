"""Effects that the catalogue does not hold: their physics, cases of them, and how answers are judged."""
