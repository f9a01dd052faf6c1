"""The self-contained HTML report: values and arrays become figures and tables (one file a kind of
picture), these become the sections of a page (``reproduction``, ``session``), and ``page`` writes
the page as one file that needs nothing else."""
