"""People: a study with participants, and training that waits for their answers.

settings                the study's folder, and the file with its settings and texts
database                all that is known of participants, pairs, answers and rounds: one SQLite file
tokens                  who may come in
pairs                   which pairs people see, and in which order
server                  what the pages ask for, over HTTP
clips, pages            what people see
statistics, analysis    what the answers tell
training                agents that learn from them
"""
