"""Evaluation: every method on the same pairs, scores stored, tables and figures made from what is stored.

    python -m sthn.evaluate SOURCE --method ... --out DIR      run, store, print the tables
    python -m sthn.evaluate.tables DIR/results.json            tables again
    python -m sthn.evaluate.figures windows DIR/results.json   curves and sheets
    python -m sthn.evaluate.terrain --bundle B --maps M        the built program, by kind of ground

Paper: Xiao et al., STHN, RA-L 2024, Sec. IV, Tables I to III.
"""
