"""HumanNeRF (Weng, Curless, Srinivasan, Barron, Kemelmacher-Shlizerman, CVPR 2022)."""
