"""Studies: what each part of the method is worth (``ablation``), and what accuracy costs (``tradeoff``).

Both run one subject under several settings (``pipeline.study``), share every version in the store that two
settings have in common, go on where they were interrupted, and leave tables, plots and one page in
``data/studies/<kind>/<name>/``.
"""
