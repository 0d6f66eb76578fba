"""Options for several hosts: mistakes refused at once, and a run that goes on elsewhere."""

import json

import pytest

from sumajax.cli.transfer import PPTransfer
from sumajax.experiment.directory import claimed
from sumajax.experiment.plan import described

HERE = "127.0.0.1:1234"


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"hosts": 2}, "hosts 2 and coordinator None do not go together; several hosts need"),
        ({"coordinator": HERE}, "hosts 1 and coordinator 127.0.0.1:1234 do not go together"),
        ({"hosts": 0}, "hosts must lie between 1 and 256, got 0"),
        ({"hosts": 2, "host": 2, "coordinator": HERE}, "host must lie between 0 and 1, got 2"),
        ({"host": 1}, "host must lie between 0 and 0, got 1"),
        ({"hosts": 2, "coordinator": "here"}, "coordinator is the HOST:PORT of host 0, got 'here'"),
        (
            {"hosts": 2, "coordinator": HERE, "devices": 2},
            "50 environments do not spread over 4 devices",
        ),
    ],
)
def test_mistakes(options, sentence):
    with pytest.raises(ValueError, match=sentence):
        PPTransfer(**options)


def test_a_run_goes_on_with_other_devices_and_hosts(tmp_path):
    output = tmp_path / "run"

    def claim(**options):
        config = PPTransfer(output=output, **options)
        return claimed(output, described(config.experiment()), config.where().options)

    with claim(devices=1):
        pass
    with claim(devices=5, hosts=2, coordinator=HERE):
        options = json.loads((output / "config.json").read_text())["options"]
    assert options["devices"] == 5
    assert not {"hosts", "host", "coordinator"} & options.keys()
    with pytest.raises(ValueError, match=r"holds a run with threshold 20\.0, not 21\.0"):
        claim(threshold=21.0).__enter__()
