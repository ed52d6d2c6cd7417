"""Studies of one subject or dataset; only dodo.py imports them.

``ablation`` finds what each part of the method is worth, ``tradeoff`` what accuracy costs in time, and
``compare`` sets our scores beside a dataset's published ones. The first two run one subject under several
settings (``variants``), share every result in the store that two settings have in common, go on where they
were interrupted, and leave tables, plots and one page in ``data/studies/<kind>/<name>/``.
"""
