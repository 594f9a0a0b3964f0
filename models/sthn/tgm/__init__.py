"""The thermal generative module: pix2pix from satellite to thermal, for ground that has no frames (paper, Sec. III-D).

python -m sthn.tgm train --help
python -m sthn.tgm generate --help
"""
