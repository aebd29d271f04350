"""The documentation as tests see it: blocks of pages, and the files that they speak of."""
