"""Training of the published network, and of anything else that takes a window and a frame to a displacement.

    python -m sthn.train experiments/table-1/ws1536-dc512.toml --out RUN --set data.root='"DATA"'
    python -m sthn.train experiments/table-1/ws1536-dc512.toml --out RUN --resume

`loop.py` is the loop; `task.py` the losses in the paper's equations; `box.py` the augmentation of the box B; `stream.py`
which pair comes when; `experiment.py` the TOML files; `saving.py` what is written.
"""
