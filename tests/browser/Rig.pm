# tests/browser/Rig.pm - rigsim's cameras and a rigd with a page, in a folder and on a loopback address of their own.
package Rig;
use strict;
use warnings;
use Cwd ();
use File::Temp ();
use IO::Socket::INET;
use POSIX ();
use Time::HiRes qw(time sleep);

sub new {
    my ($class, $n_cameras) = @_;
    my $bin = $ENV{BIN} // 'build/bin';
    my $dir = File::Temp::tempdir('studiorig-test-XXXXXX', TMPDIR => 1, CLEANUP => 1);
    # whoever runs at the same time has another (tests/loopback.h)
    my $address = sprintf '127.%d.%d.%d', 1 + ($$ >> 16 & 127), $$ >> 8 & 255, $$ & 255;
    my $self = bless { bin => $bin, dir => $dir, n => $n_cameras, address => $address, port => 8420, wires => "$dir/w" }, $class;
    my @sim = ("$bin/rigsim", '--cameras', $n_cameras, '--address', $address, qw(--personality nikon --seed 1 --raw-size 408x272 --trigger-socket), $self->{wires});
    $self->{list} = `@sim --list`;
    $self->{sim} = run("$dir/sim.log", @sim);
    $self->up('sim', sub { -S $self->{wires} });
    return $self;
}

# Waits until it is there. A program that has ended ends this one, too, with what it said.
sub up {
    my ($self, $which, $is_there) = @_;
    my $program = { sim => 'rigsim', rigd => 'rigd' }->{$which};
    for (my $end = time + 120; time < $end; sleep .05) {
        return if $is_there->();
        if (waitpid($self->{$which}, POSIX::WNOHANG)) {
            delete $self->{$which};
            die "# $program has ended\n", $self->logs;
        }
    }
    die "# $program is not there after two minutes\n", $self->logs;
}

# The end of what both said, as comments of TAP.
sub logs {
    my ($self) = @_;
    my $text = '';
    for my $name (qw(sim rigd)) {
        open my $f, '<', "$self->{dir}/$name.log" or next;
        my @lines = <$f>;
        $text .= "# $name.log: $_" for @lines > 15 ? @lines[-15 .. -1] : @lines;
    }
    return $text;
}

sub run {
    my ($log, @command) = @_;
    my $pid = fork // die "fork: $!";
    return $pid if $pid;
    open STDOUT, '>>', $log;
    open STDERR, '>&', \*STDOUT;
    exec @command or die "$command[0]: $!";
}

sub url { "http://$_[0]{address}:$_[0]{port}/" }

sub start { # wires: where its trigger is looked for
    my ($self, $wires) = @_;
    my ($dir, $list) = ($self->{dir}, $self->{list});
    $list =~ s/^address = .*/address = $wires/m if $wires;
    open my $f, '>', "$dir/rigd.conf" or die $!;
    print $f "[rig]\nname = studio <b>one</b>\ntakes = $dir/takes\nstate = $dir/state\nsocket = $dir/s\npersonality_dir = ", Cwd::getcwd(), "/config/cameras\nraw_mb = 2\nfree_space_mb = 1\n",
        "[web]\nlisten = $self->{address}:$self->{port}\n[settings]\niso = 100\nshutter = 1/125\n", $list;
    close $f;
    $self->{rigd} = run("$dir/rigd.log", "$self->{bin}/rigd", '--config', "$dir/rigd.conf");
    $self->up('rigd', sub { IO::Socket::INET->new(PeerAddr => $self->{address}, PeerPort => $self->{port}) });
}

sub stop { # how long it took, in seconds
    my ($self, $signal) = @_;
    my $began = time;
    return 0 unless $self->{rigd};
    kill $signal // 'TERM', $self->{rigd};
    waitpid delete $self->{rigd}, 0;
    return time - $began;
}

sub DESTROY {
    my ($self) = @_;
    local $?;
    $self->stop;
    return unless $self->{sim};
    kill 'TERM', $self->{sim};
    waitpid $self->{sim}, 0;
}
1;
