"""A bench file by question and answer: what is asked, what this machine offers, the file that comes of it."""
