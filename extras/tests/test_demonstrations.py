"""Each training of the comparison is one that `train` takes, and has a folder of its own."""

from deepflight import FLAGS, SETTINGS, configure, parse
from extras.experiments.demonstrations import KINDS, SEEDS, STEPS, trainings


def test_each_training_of_the_comparison_is_legal_and_has_a_folder_of_its_own() -> None:
    names = [name for name, *_ in trainings()]
    assert len(names) == len({*names}) == len(KINDS) * len(SEEDS)
    for *_, flags in trainings():
        args = vars(parse(["train", *flags]))
        changes = [FLAGS[name] for name in FLAGS if args.get(name)]
        changes.append({f.name: args[f.name] for f in SETTINGS if f.name in args})
        c, _ = configure({key: x for some in changes for key, x in some.items()})
        assert c.steps == STEPS
