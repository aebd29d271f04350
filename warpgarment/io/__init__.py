"""File formats. `mesh` and `sequence` choose by suffix; the others hold one format, or one idea, each."""
