"""Reports: from runs to data, to pictures, to one page, PNG and GIF.

contents   what a report says of runs                  (data of a page)
episodes   an episode as a film                        (the only module that asks a game)
slices     V around the target set
data       what all of these are made of
scene      a film as a picture, for every renderer
charts     curves as pictures
plot       Matplotlib: scenes and charts as SVG and PNG
png, gif   pictures as files
page       the page, one self-contained HTML file
"""
