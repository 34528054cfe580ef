"""A bench file by question and answer: the questions, this machine's hardware, the resulting file."""
