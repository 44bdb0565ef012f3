"""Reports: from runs to data, to pictures, to one page, PNG and GIF.

    contents   what a report says of runs: `gather` makes a `Page` of them
    measuring  runs evaluated on the same starts, and their logs
    filming    which starts are filmed, and who drives beside a run
    changes    fields that are not the default, and the command that makes a run
    episodes   an episode as a `Film`: `one`, `driven`
    slices     V around the target set
    data       the records that all of these are made of
    scene      a film as a picture, for every renderer
    charts     curves as charts
    words      numbers in words
    plot       Matplotlib draws scenes and charts, and writes SVG
    png, gif   pictures as files; mp4 by ffmpeg
    paper      figures for papers, as axes that one can change
    interactive  the charts and level sets of the page, drawn by Bokeh
    page       `html`: one self-contained file, from page.html, style.css and two scripts

The modules from plot on load Matplotlib or Bokeh, so the command line imports them only when it
draws.
"""
