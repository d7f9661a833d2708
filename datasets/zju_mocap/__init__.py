"""ZJU-MoCap: its original layout, the refined poses, HumanNeRF's folders."""
