"""What `marlyap` says without arguments: what people do first."""

FIRST = """marlyap: train teams of controllers, hold them to a Lyapunov condition, measure them.

Five things people do first:
  marlyap demo                            train a team, measure it, see it move (a minute or two)
  marlyap list                            see the games, algorithms, controllers and certificates
  marlyap train rendezvous-rest apg       train a team on a game of that list
  marlyap report RUN                      measure a run, and look at it in a browser
  marlyap certify RUN                     say what holds of it, and on what evidence

`marlyap --help` lists every command, `marlyap COMMAND --help` its options and examples.
"""
