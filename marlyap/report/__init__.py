"""Reports: from runs to data, to pictures, to one page, PNG and GIF.

    contents   what a report says of runs: `gather` makes a `Page` of them
    changes    fields that are not the default, and the command that makes a run
    episodes   an episode as a `Film`: `one`, `films`
    slices     V around the target set
    data       the records that all of these are made of
    scene      a film as a picture, for every renderer
    charts     curves as pictures
    words      numbers in words
    plot       Matplotlib draws scenes, charts and slices, and writes SVG
    png, gif   pictures as files
    page       `html`: one self-contained file, from page.html, style.css and player.js

The last four modules load Matplotlib, so the command line imports them only when it draws.
"""
