"""`torchelev fleet`: simulated robots explore a terrain together, and a site map holds what they saw.

`world` makes the terrain, `robots` move and sense in it, `explore` chooses where they go, `mission` is the loop,
`numbers` and `picture` say how it went. What a site map is, is not here: see `torchelev.site`.
"""
