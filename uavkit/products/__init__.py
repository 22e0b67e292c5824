"""Products of a survey: what is made of its results for other programs and people."""
