"""Third-party scenes: NuRec archives, OpenUSD particle fields, 3DGS PLY files (docs/foreign_scenes.md)."""
